"""What a detector makes of scenes: agreement of recorded and rendered images, and training sets of renders."""
