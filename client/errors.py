"""What can go wrong, as one tree. Each message is one sentence: what, where, what to do.

GamesrError
+-- InputError       the video cannot be read, or is of a kind that is not supported
+-- OutputError      the result cannot be written
+-- ModelError       the artifact is not one of ours, is damaged, or does not fit the request
+-- ProviderError    the execution provider that was asked for is not available
"""


class GamesrError(Exception):
    """Anything that a caller did or met; the command line prints it as one sentence and exits 1."""


class InputError(GamesrError):
    pass


class OutputError(GamesrError):
    pass


class ModelError(GamesrError):
    pass


class ProviderError(GamesrError):
    pass


def how_to_install(*extras: str) -> str:
    """What to do where an extra is missing: the end of a sentence. No package index has a GameSR, so no name on one is advised."""
    return f"in the folder of GameSR's source, pip install -c constraints.txt '.[{','.join(extras)}]'"
