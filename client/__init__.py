"""The runtime: decode a game stream, upscale it frame by frame with a recurrent network, show or encode it."""
