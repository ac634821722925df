"""Light through lenses and pipe."""
