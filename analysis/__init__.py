"""Studies, reports and comparisons: above all other packages."""
