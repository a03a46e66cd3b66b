"""The workshop: GameSR's networks in torch, their training, reparameterization, export and verification."""
