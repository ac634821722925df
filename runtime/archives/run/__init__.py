"""A bulk run: its job, its ledger of ranges, and what was found, added up."""
