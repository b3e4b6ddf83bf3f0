"""SPZ, the compressed format of Niantic: version 4 written, versions 1 to 4 read."""
