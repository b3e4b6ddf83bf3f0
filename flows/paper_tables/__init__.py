"""The paper's tables: each a flow over methods and chunks, written with the paper's numbers beside the measured."""
