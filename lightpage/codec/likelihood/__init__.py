"""What symbols say of their bits: log-likelihood ratios and the information in them."""
