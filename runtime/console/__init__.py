"""A local web page that shows how a running service fares. It changes nothing."""
