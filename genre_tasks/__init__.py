"""What each step of the pipeline does: functions from values to values (no Prefect, no artifact formats)."""
