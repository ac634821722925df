"""Likelihoods of bits: log-likelihood ratios of the symbols' bits, and the information in them."""
