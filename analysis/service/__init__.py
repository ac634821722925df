"""The service under load, faults and attack, measured from outside: a process of its own, over real connections."""
