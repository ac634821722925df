"""Maximum likelihood of a page's phases by the fitted waves, as modules that are exported."""
