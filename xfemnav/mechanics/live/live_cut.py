"""A cut in a condensed organ as it lies now: a value, from which the next one is made."""

from dataclasses import dataclass, field, replace

import numpy as np

from xfemnav.errors import XfemnavError
from xfemnav.mechanics.live.condensation import Condensation
from xfemnav.mechanics.live.incision import Incision
from xfemnav.mechanics.live.lip_modes import lip_modes
from xfemnav.mechanics.live.live_motion import LiveMotion, Soup
from xfemnav.mechanics.rules import BLADE, LipRules, Retraction
from xfemnav.mechanics.solving.solution import RetractorForce


@dataclass(frozen=True, eq=False)
class LiveCut:
    """The triangles of an organ, cut or not; where they are; and the force of the blade on each lip, by its side.

    Nothing of it changes but for `modes`, which all places of one cut share: those of blades on some lips, by sides and
    blade, are worked out when they are first asked for.
    """

    soup: Soup
    motion: LiveMotion
    forces: dict[int, RetractorForce] = field(default_factory=dict)
    modes: dict = field(default_factory=dict)

    @classmethod
    def at_rest(cls, organ: Condensation, incision: Incision | None = None) -> "LiveCut":
        """An organ with a cut in it, or without one, whose lips nothing has moved."""
        n = 0 if incision is None else incision.space.enrichment.n_rows
        soup = Soup(organ, incision)
        return cls(soup, LiveMotion(soup, np.zeros((len(organ.mesh.points), 2)), np.zeros((n, 2))))

    def moved(self, moves: dict, blade, rules: LipRules, at_once: bool) -> "LiveCut":
        """The same cut with its lips moved: `moves` by side, (1,) mm away from the other lip or (2,) plane mm.

        blade: the held part of the cut, None for the usual one. at_once: for a cut that has not been opened yet, whose
        modes come later. Raises XfemnavError E402, E403, E405, E407.
        """
        modes = self._modes_of(tuple(moves), blade, rules)
        amounts = np.concatenate([np.zeros(0), *([*move, 0.0] if len(move) == 2 else [0.0, 0.0, *move]
                                                 for move in moves.values())])
        if (opening := modes.opening(amounts)) < -1e-9:
            raise XfemnavError("E405", f"left and right look swapped: the lips are pushed {-opening:.1f} mm into each "
                                       "other; left is left when walking from the mouth to the tip.")
        answer, pressing = modes.free(amounts), None
        if rules.touch:
            pressing = modes.pressing(amounts)
        if pressing is not None:
            answer += pressing
        if at_once:
            U, own = (field[..., 0] for field in modes.carried(answer.u[:, None]))
        else:
            U, own = (field @ amounts for field in modes.fields)
            if pressing is not None:
                U, own = (field + more[..., 0] for field, more in zip((U, own), modes.carried(pressing.u[:, None])))
        return replace(self, motion=LiveMotion(self.soup, U, own), forces=_told(modes, answer))

    def _modes_of(self, sides: tuple[int, ...], blade, rules):
        key = sides, blade
        if key not in self.modes:
            held = tuple(Retraction(0, side, normal_mm=1.0, blade=blade or BLADE, blade_given=blade is not None)
                         for side in sides)
            self.modes[key] = lip_modes(self.soup.incision, held, rules)
        return self.modes[key]


def _told(modes, answer) -> dict:
    """The force of each blade by the side of its lip."""
    return {blade.side: RetractorForce(blade.cut, blade.side, tuple(force.tolist()), float(push / length))
            for blade, force, push, length in zip(modes.blades, answer.force, answer.push, modes.lengths)}
