"""The tests, one package for each package that they test."""
