"""Fields beside the image, such as fibres and tensors, and their values in cells."""
