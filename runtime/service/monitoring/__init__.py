"""What an operator sees of the service: metrics, logs, traces, signs of drift, and frames of lost pages."""
