"""What sections of a scenario say of each other: every wrong name is told, with the nearest right one."""

import pytest

from xfemnav.pipeline.asking.crosscheck import cross_problems

CUT = {"name": "approach", "points": [[0, 0], [1, 1]]}
BLADE = {"name": "blade", "cut": "approach", "side": "left", "displacement_mm": [1, 1]}
TUMOUR = {"name": "tumour", "outline": [[0, 0], [1, 0], [0, 1]]}


def problems(**sections):
    return "\n".join(cross_problems({"xfemnav": 1, "cut": [CUT], "retract": [BLADE], "resect": [TUMOUR],
                                     "load": {"gravity": [0, -1]}} | sections))


def step(name, **keys):
    return {"name": name} | keys


def test_a_right_scenario_has_no_problem():
    assert problems() == ""
    steps = [step("shift", acts=["gravity"]), step("cut", acts=["approach"]), step("open", acts=["blade"])]
    assert problems(step=[*steps, step("out", acts=["tumour"]), step("end", ends=["blade"])]) == ""


@pytest.mark.parametrize("steps, text", [
    ([step("a", acts=["aproach"])], "step.0.acts: nothing is called 'aproach', did you mean 'approach'?"),
    ([step("a", acts=["approach"]), step("b", acts=["approach"])], "step.1.acts: 'approach' acts already"),
    ([step("a"), step("a")], "step.1.name: two steps are called 'a'"),
    ([step("a b"), step("ab")], "step.1.name"),
    ([step("a", ends=["tumour"])], "'tumour' is no retraction, pressure or gravity"),
    ([step("a", acts=["gravity"]), step("b", ends=["gravity"]), step("c", ends=["gravity"])],
     "step.2.ends: 'gravity' does not act by then"),
    ([step("a"), step("b", acts=["approach"])], "step.0: 'blade' acts before its cut 'approach'"),
])
def test_steps(steps, text):
    assert text in problems(step=steps)


def test_names_that_steps_could_not_tell_apart():
    twins = [BLADE, BLADE | {"side": "right"}]
    assert problems(retract=twins) == ""
    assert "the name 'blade' is taken" in problems(retract=twins, step=[step("a")])
    assert "the name 'approach' is taken" in problems(resect=[TUMOUR | {"name": "approach"}], step=[step("a")])
    assert "two resections are called 'tumour'" in problems(resect=[TUMOUR, TUMOUR])


def test_labels_and_pressures_need_what_they_name():
    assert "resect.0.label" in problems(resect=[{"name": "tumour", "label": 7}])
    assert problems(resect=[{"name": "tumour", "label": 7}], tissue={"labels": "a.nii"}) == ""
    pressure = {"load": {"pressure": [{"on": "tumor", "kpa": 1.0}]}}
    assert "no resection is called 'tumor', did you mean 'tumour'?" in problems(**pressure)
    assert problems(load={"pressure": [{"on": "outline", "kpa": 1.0}]}) == ""


def test_plane_millimetres_are_not_read_in_voxels():
    for boundary in ({"displacement": "a.csv"}, {"arc": [{}]}):
        assert "'voxel'" in problems(space="voxel", boundary=boundary)


@pytest.mark.parametrize("nonsense", [
    {"step": 3}, {"step": [3]}, {"step": [step("a", acts=3)]}, {"load": 3}, {"load": {"pressure": 3}}, {"tissue": 3},
    {"cut": {}}, {"retract": [{"cut": 3}]}, {"resect": [{}]}, {"boundary": 3, "space": "voxel"},
])
def test_what_has_the_wrong_form_is_left_to_the_schema(nonsense):
    problems(**nonsense)


def test_a_pressure_begins_with_its_resection_or_later():
    load = {"pressure": [{"name": "packing", "on": "tumour", "kpa": 1.0}]}
    out, cut = step("out", acts=["tumour"]), step("cut", acts=["approach", "blade"])
    assert problems(load=load, step=[cut, out]) == ""
    early = problems(load=load, step=[step("cut", acts=["approach", "blade", "packing"]), out])
    assert early == "step.0: the pressure 'packing' acts before the resection 'tumour'"
