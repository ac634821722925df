"""The client, and what travels on the wire between it and the service: messages, addresses, certificates, statuses.

The wheel `lightpage-client` is made of this room and of what it imports of `model`, so it stays small. It imports
nothing else of `lightpage.runtime`.
"""
