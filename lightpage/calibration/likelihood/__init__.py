"""Statistics of a device's counts and Fisher information of its symbols, for estimation by maximum likelihood."""
