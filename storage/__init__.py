"""Bytes: Parquet and EXR codecs of the domain's types, manifests, stores, lineage. No algorithms."""
