"""Parts of machines as problems for the search: joints, axes, pads, cells."""
