"""What a render is compared with, and the losses that compare them."""
