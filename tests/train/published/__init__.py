"""Tests of the package `lightpage.train.published`."""
