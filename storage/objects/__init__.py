"""The store in a bucket of an object store: S3, Google Cloud Storage, Azure, or a server that speaks S3."""
