"""The content that a mesh represents: images, labels and masks."""
