"""Tests of what runs beside the service."""
