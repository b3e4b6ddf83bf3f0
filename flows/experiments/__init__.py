"""What cost sweeps and paper tables share: chunks, stages of a cell, their costs, predictions and warm-up."""
