"""Scenes in the formats of other people's tools: 3DGS PLY, .splat, SPZ, glTF and OpenUSD, in and out."""
