"""Localizers: from a recovered field to features that lie where their symbol lies on the page."""
