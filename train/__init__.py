"""Torch: the differentiable twins, localizers, networks, loss and fitting."""
