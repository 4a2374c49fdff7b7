"""The table of stages."""

from dataclasses import replace

from xfemnav.pipeline.stages import (
    solid_constrain,
    solid_figure,
    solid_mesh,
    solid_safe,
    solid_segment,
    solid_solve,
    solid_warp,
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
SOLID_STAGES: dict[str, Stage] = {stage.name: stage for stage in (
    replace(STAGES["segment"], code=solid_segment, files=("image", "mask"),
            line=lambda f: f"{f['segmentation']['volume_mm3'] / 1000:.0f} ml by {f['segmentation']['method']}"),
    replace(STAGES["mesh"], code=solid_mesh, files=()),
    replace(STAGES["constrain"], code=solid_constrain, files=("labels",)),
    replace(STAGES["solve"], code=solid_solve, libraries=(*ALL, "pyamg"), needs=("segment", "mesh", "constrain")),
    replace(STAGES["warp"], code=solid_warp, line=lambda f: f"cavity {f['checks']['cavity_mm3'] / 1000:.2f} ml"),
)}
#: The stages of a run by its dimension.
STAGES_OF = {2: STAGES, 3: SOLID_STAGES}
CARRY = Stage("carry", PHYSICS, IMAGING, ("segment", "mesh", "constrain", "solve", "warp"),
              ("companion", "points", "streamlines", "surfaces"), stage_carry, stage_carry.line, kept=False)
FIGURE = Stage("figure", ("pipeline",), (*IMAGING, "matplotlib"), ("segment", "constrain", "solve", "warp"), (),
               stage_figure, lambda f: "")
FIGURE_OF = {2: FIGURE, 3: replace(FIGURE, code=solid_figure)}
SAFE = Stage("safe", ("pipeline",), (*ALL, CHOLMOD), ("segment", "mesh"), ("labels", "resection"), stage_safe,
             lambda f: "")
#: By the dimension of a run.
SAFE_OF = {2: SAFE, 3: replace(SAFE, code=solid_safe, needs=("segment", "mesh", "solve"), files=("labels",))}
