"""The client, and what travels on the wire between it and the service: messages, addresses, certificates, statuses.

`client.py` is the client. It has a part for each kind of calls: `frames.py`, `pages.py`, `display.py`, `jobs.py` and
`models.py`, which share one `connection.py`. `answers.py` lists what callers get.

The wheel `lightpage-client` is made of this room and of what it imports of `model`, so it stays small. It imports
nothing else of `lightpage.runtime`.
"""
