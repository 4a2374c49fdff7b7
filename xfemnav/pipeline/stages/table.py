"""The table of stages."""

from xfemnav.pipeline.stages import (
    stage_carry,
    stage_constrain,
    stage_figure,
    stage_mesh,
    stage_safe,
    stage_segment,
    stage_solve,
    stage_warp,
)
from xfemnav.pipeline.stages.stage import Stage

IMAGING = ("numpy", "scipy", "scikit-image", "SimpleITK", "nibabel", "shapely", "numba")
ALL = (*IMAGING, "meshio")
CHOLMOD = "scikit-sparse"  # solves where it is installed
PHYSICS = ("imaging", "mechanics")

STAGES: dict[str, Stage] = {stage.name: stage for stage in (
    Stage("segment", ("imaging",), IMAGING, (), ("image", "mask", "template", "template_mask"), stage_segment,
          lambda f: f"{f['segmentation']['area_mm2']:.0f} mm2 by {f['segmentation']['method']}"),
    Stage("mesh", ("imaging",), ALL, ("segment",), ("mesh_file",), stage_mesh,
          lambda f: f"{f['mesh']['n_nodes']} nodes, quality {f['mesh']['min_quality']:.2f}"),
    Stage("constrain", PHYSICS, IMAGING, ("segment", "mesh"), ("labels", "resection"), stage_constrain,
          lambda f: "{n_dof} unknowns, {added_dof} for the cut".format(**f["enrichment"])),
    Stage("solve", PHYSICS, (*ALL, CHOLMOD), ("segment", "constrain"), (), stage_solve,
          lambda f: "moves up to {max_displacement_mm:.2f} mm; {nnz} matrix entries, {added_nnz} for the cut, "
                    "{memory_kB:.0f} kB".format(**f["checks"], **f["matrix"])),
    Stage("warp", PHYSICS, IMAGING, ("segment", "mesh", "constrain", "solve"), (), stage_warp,
          lambda f: f"cavity {f['checks']['cavity_mm2']:.0f} mm2"),
)}
CARRY = Stage("carry", PHYSICS, IMAGING, ("segment", "mesh", "constrain", "solve", "warp"),
              ("companion", "points", "streamlines", "surfaces"), stage_carry, stage_carry.line, kept=False)
FIGURE = Stage("figure", ("pipeline",), (*IMAGING, "matplotlib"), ("segment", "constrain", "solve", "warp"), (),
               stage_figure, lambda f: "")
SAFE = Stage("safe", ("pipeline",), (*ALL, CHOLMOD), ("segment", "mesh"), ("labels", "resection"), stage_safe,
             lambda f: "")
