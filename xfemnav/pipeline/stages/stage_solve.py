"""The stage solve: a boundary value problem becomes deformed triangles, or tetrahedra."""

from xfemnav.limits import FOLDED_NOTICE

SIDES = (("left", 1), ("right", -1))
UNITS = {2: "_per_mm", 3: ""}  # of forces and energies, by the dimension: a slice is as thick as one asks


def compute(params, inputs):
    """The motion of the tissue: a Solution."""
    from xfemnav.errors import warn
    from xfemnav.mechanics.solving.solution import solve

    solution = solve(inputs.value("constrain"))
    notice = FOLDED_NOTICE[solution.rest.shape[2]].value
    if solution.inverted_mm2 > notice:
        worst = ", ".join(f"{x:.1f}" for x in solution.rest[solution.det_F.argmin()].mean(axis=0))
        unit = f"mm{solution.rest.shape[2]}"
        warn("W402", f"{solution.inverted_mm2:.3g} {unit} of tissue is turned inside out, over {notice:g} {unit}, the "
                     f"worst near ({worst}) mm.")
    return solution


def facts(value, params, inputs):
    """What run.json says of the stage."""
    from xfemnav.mechanics.solving.measures import measure

    problem = inputs.value("constrain")
    names, measured = [cut.name for cut in problem.cuts], measure(problem, value)
    turning, d = measured.turning, problem.mesh.dim
    per_mm = UNITS[d]
    return {
        "retractor": [{"cut": names[force.cut], "side": "left" if force.side > 0 else "right",
                       f"force_mN{per_mm}": list(force.force_mN_per_mm), "mean_pressure_kPa": force.mean_pressure_kPa,
                       **_held(problem, force.cut, span)}
                      for force, span in zip(value.retractor, problem.spans)],
        "tips": [{"cut": names[tip.cut], "point_mm": list(tip.point_mm), "K_I_Pa_sqrt_m": tip.K_I_Pa_sqrt_m,
                  "K_II_Pa_sqrt_m": tip.K_II_Pa_sqrt_m, "radius_mm": tip.radius_mm} for tip in value.tips],
        "contact": [{"where": names[each.cut] if each.cut >= 0 else "skull", "length_mm": each.length_mm,
                     "mean_pressure_kPa": each.mean_pressure_kPa} for each in value.contact],
        "model": {"name": value.model, "load_steps": value.load_steps, "newton_iterations": value.newton_iterations,
                  "linear_difference_mm": value.linear_difference_mm},
        f"energy_uJ{per_mm}": value.energy,
        "matrix": {"nnz": value.nnz, "added_nnz": value.added_nnz, "memory_kB": value.matrix_kB},
        "checks": {
            "residual": value.residual,
            f"inverted_mm{d}": value.inverted_mm2,
            "det_F_p01": value.det_F_p01,
            "largest_strain": value.largest_strain,
            "min_gap_mm": value.min_gap_mm,
            "lip_error_mm": {"rms": value.lip_error_rms_mm, "max": value.lip_error_max_mm},
            "max_displacement_mm": value.max_displacement_mm,
            "mean_displacement_mm": mean_displacement(value.rest, value.moved),
            "main_strain": measured.main_strain,
            "turning_mm": turning and turning.error_mm,
            "turned_deg": turning and turning.degrees,
            f"turned_mm{d}": turning and turning.area_mm2,
            f"resized_mm{d}": measured.resized_mm2,
            f"tripled_mm{d}": measured.tripled_mm2,
            "blade_pressure_kPa": max((abs(force.mean_pressure_kPa) for force in value.retractor), default=None),
            "main_young_kpa": measured.main_young_kpa,
        },
        "places": {name.replace("_mm2", f"_mm{d}"): list(place) for name, place in measured.places.items()},
    }


def inverted_area(rest, moved) -> float:
    """Area at rest (mm^2) of the triangles (t, 3, 2) that are turned over when moved."""
    from xfemnav.geometry.mesh import orient

    before, after = (orient(x[:, 0], x[:, 1], x[:, 2]) / 2 for x in (rest, moved))
    return float(before[before * after < 0].sum())


def mean_displacement(rest, moved) -> float:
    """Mean length of the displacement (mm) of simplices (t, d + 1, d), by their size at rest; at their corners."""
    import numpy as np

    from xfemnav.geometry.mesh import volumes

    areas = abs(volumes(rest))
    return float(np.average(np.linalg.norm(moved - rest, axis=2).mean(axis=1), weights=areas))


def _held(problem, cut, span):
    """The part of a cut that a blade holds, from the mouth: what was asked, but for what is too near to a tip."""
    if span.ndim > 1:
        along, depth = span[:, :2].clip(0, 1).round(6).T.tolist()
        return {"blade": depth, "blade_along": along}
    return {"blade": [round(min(float(end) / problem.cuts[cut].length, 1.0), 6) for end in span]}


def publish(value, params, inputs, folder):
    """Write the stage's public files into `folder`."""
    from xfemnav.imaging.points.markups import write_markups
    from xfemnav.pipeline.keeping.files import write_soup

    slice, _ = inputs.value("segment")
    write_markups(folder / "cuts.mrk.json", _drawn(slice, inputs.value("constrain"), value))
    write_soup(folder / "solution.vtu", slice, value.rest, value.moved,
               {"strain": value.strain, "det_F": value.det_F, "piece": value.body})


def _drawn(slice, problem, solution):
    """Each cut at rest, and its two lips now, as curves of point sets in the world."""
    from xfemnav.imaging.points.point_set import PointSet

    for k, (cut, path) in enumerate(zip(problem.cuts, solution.motion.cuts)):
        lips = ((f"{cut.name}, {name} lip now", solution.motion.lip_now(k, side)) for name, side in SIDES)
        for name, points in ((cut.name, path), *lips):
            if len(points) > 1:  # a lip may be resected
                yield PointSet("Curve", name, slice.to_world(points), ("",) * len(points))
