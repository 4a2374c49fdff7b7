"""A problem without its blades: where lips lie under all else that acts, from where blades' displacements may count."""

import warnings

import numpy as np
from scipy.sparse import csr_array

from xfemnav.errors import XfemnavError
from xfemnav.mechanics.conditions.bodies import at_rest, sort_out
from xfemnav.mechanics.conditions.conditions import Conditions
from xfemnav.mechanics.conditions.constraints import stack
from xfemnav.mechanics.conditions.contact import join, lip_contacts
from xfemnav.mechanics.conditions.skull import OutlineConditions, hung
from xfemnav.mechanics.rules import LipRules
from xfemnav.mechanics.space.space import Space


def without_blades(space: Space, cuts, resections, outline: OutlineConditions, load, rules: LipRules) -> Conditions:
    """The conditions on the same basis without those of blades. Pieces that only blades hold stay at their mean.

    load (n_dof,) mN: that of weight and pressures. Raises XfemnavError E406 where blades alone hold the organ.
    """
    n_dof = space.enrichment.n_dof
    weak = hung(space, outline.constraints, outline.springs, outline.weak)
    springs = outline.springs if weak is None else csr_array(outline.springs + weak)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # what is loose is told of with the blades
            conditions, means, gone, _ = sort_out(space, cuts, resections, (), outline.constraints, springs, "hold")
    except XfemnavError as error:
        if error.code != "E406":
            raise
        raise XfemnavError(
            "E406",
            "nothing but blades holds the organ, so where their lips lie under the loads alone cannot be told; use "
            '⟦skull=fixed⟧, or say relative_to = "rest" of each [[retract]].',
        ) from None
    conditions = stack([conditions, at_rest(space.enrichment, gone)], n_dof)
    touching = [outline.contacts]
    if rules.touch:
        touching.append(lip_contacts(space, (), np.empty((0, 2)), space.parts.removed | gone))
    contacts = join(touching, n_dof)
    return Conditions(conditions, springs, outline.load + load, contacts if len(contacts.gap) else None, weak, means)
