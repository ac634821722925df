"""The device: cameras, trigger, modulator and shutters, and the frame sources made of them.

`cameras`, `trigger` and `modulator` each talk to one kind of hardware; `acquisition` pairs frames with pages and offers
them as a `FrameSource`. This room imports nothing else of `lightpage.runtime`.
"""
