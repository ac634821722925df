"""From a few known pages to a device's geometry."""
