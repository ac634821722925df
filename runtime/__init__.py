"""No torch: bundle, decoder, frame sources, recalibration, gRPC service, client, command line."""
