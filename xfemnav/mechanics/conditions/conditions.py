"""Conditions: all that holds, moves and loads an organ, as matrices and vectors on the functions of a space."""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array

from xfemnav.geometry.mesh import frozen_array
from xfemnav.mechanics.conditions.constraints import Constraints, Contacts, Means


@dataclass(frozen=True, eq=False)
class Conditions:
    """Minimise 1/2 U'(K + springs)U - load'U under C U = d (`constraints`) and, where surfaces may touch,
    G U + gap >= 0 (`contacts`); and with mean 0 over each piece that nothing else holds (`means`).

    springs (n_dof, n_dof) kPa: the skull's ramp and the terms of Nitsche's condition, as stiffness, among them those by
    which `hung` holds what else only touches. load (n_dof,) mN.
    """

    constraints: Constraints
    springs: csr_array
    load: np.ndarray
    contacts: Contacts | None = None
    hung: csr_array | None = None
    means: Means | None = None

    def __post_init__(self):
        object.__setattr__(self, "springs", csr_array(self.springs))
        object.__setattr__(self, "load", frozen_array(self.load, float, (self.springs.shape[0],), "load"))
