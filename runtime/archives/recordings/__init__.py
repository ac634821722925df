"""Many pages of one device: what a bundle is worth on them."""
