"""The main job on a simulated device."""

from lightpage.temporary import settle_matplotlib

settle_matplotlib()
