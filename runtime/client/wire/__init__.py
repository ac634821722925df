"""Messages, statuses and addresses."""
