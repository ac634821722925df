"""The runtime: it decodes pages, serves them, and recalibrates, without torch.

A page's way leads from `device` (cameras, or any other source of frames) through `model` (a bundle, executed) to
`service` (gRPC) and to `client` (callers, and what travels between both). `recalibration` fits a drifted device anew,
`archives` reads many recorded pages at once, `console` is the service's web page, and `commands` has the subcommands of
`lightpage`. docs/reference/architecture.md shows each way file by file.
"""
