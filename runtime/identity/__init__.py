"""Who calls: certificates, roles, and what each of them may do."""
