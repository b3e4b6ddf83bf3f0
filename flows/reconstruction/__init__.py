"""The flow that takes a log, or a dataset of logs, through the pipeline, with its run records and its report."""
