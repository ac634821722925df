"""Studies, reports and comparisons: above all other packages."""

from lightpage.temporary import settle_matplotlib

settle_matplotlib()
