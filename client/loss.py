"""The loss rule: what may still be wrong in a picture because something before it did not arrive."""

from __future__ import annotations

from client.access_unit import AccessUnit


class LossRule:
    """Judges access units in order: a picture is damaged from a loss to the next point that owes nothing to it.

    Such a point is an IDR of which nothing is missing, or the end of an exact intra refresh: a recovery point (SEI) with
    nothing missing from it until `recovery_frames` reference pictures later. Until the first of either `begun` is False:
    there is nothing that could be decoded. `heals` says that this sender has shown a recovery point.
    """

    def __init__(self, parameters_known: bool = False) -> None:
        self.begun = self.heals = False
        self.damaged = True
        self._parameters_known = parameters_known
        self._until_exact: int | None = None  # reference pictures

    def admit(self, unit: AccessUnit) -> bool:
        """Whether this unit's picture may differ from what was sent; units come in order, each once."""
        content = unit.content
        if unit.restarted:
            self.begun = self.heals = False
        if unit.restarted or unit.lost_packets or not unit.whole:
            self.distrust()
        self._parameters_known |= content.parameters
        if self._parameters_known and (content.idr or content.recovery_frames is not None):
            self.begun = True
        if unit.whole and self.begun:
            if content.idr:
                self._until_exact = 0
            elif content.recovery_frames is not None and self._until_exact is None:
                self.heals = True
                self._until_exact = content.recovery_frames
        if self._until_exact == 0:
            self.damaged = False
            self._until_exact = None
        elif self._until_exact is not None and content.reference:
            self._until_exact -= 1
        return self.damaged

    def distrust(self) -> None:
        """Something was lost: nothing is known to be right any more."""
        self.damaged = True
        self._until_exact = None
