"""Filming free games: the training and test footage, rendered again by anyone."""
