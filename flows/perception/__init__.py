"""What a detector makes of scenes: agreement of recorded and rendered images, and labelled renders to train with."""
