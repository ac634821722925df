"""Statistics of a device's counts, and the Fisher information of its symbols: what maximum likelihood needs."""
