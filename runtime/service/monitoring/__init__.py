"""Monitoring of the service for its operator: metrics, logs, traces, signs of drift, and frames of lost pages."""
