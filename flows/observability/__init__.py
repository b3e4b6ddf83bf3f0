"""What a worker tells of its work: log records with their stage, and counts for Prometheus."""
