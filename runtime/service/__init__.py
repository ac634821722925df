"""The service: it decodes frames, reads pages, keeps models, recalibrates, and shows pages, for callers by gRPC.

There is one folder for each thing that a caller does, with the gRPC handler beside the logic that it calls: `frames`,
`pages`, `models`, `jobs`, `display`. `server` takes a call from its first byte to its status, `monitoring` is what an
operator sees. What all of them share lies beside this file: `dataplane` decodes and tells of each page, `admission` and
`limits` bound what is at work, `caller` is who asks, `settings` is what an operator sets.

This room imports `model`, `device`, `recalibration`, `archives` and the messages of `client`.
"""
