"""The `lightpage` command and what its subcommands share."""
