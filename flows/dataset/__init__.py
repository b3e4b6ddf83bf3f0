"""A dataset of many logs: its flow, its table and its report."""
