"""Measures and reports: what upscaling on the client buys in bits, and what it costs in milliseconds."""
