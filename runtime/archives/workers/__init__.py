"""Workers of a bulk run, in this process, in others of this machine, or on a Ray cluster."""
