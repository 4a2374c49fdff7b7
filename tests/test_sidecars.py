"""Sidecars of the motion's files: JSON, and every field says its unit, frame, direction and what is in the gap."""

import json

import pytest

from xfemnav.imaging.carrying.gaps import NOWHERE
from xfemnav.imaging.carrying.lip_labels import LEFT, RIGHT
from xfemnav.imaging.carrying.sidecars import SIDECARS


@pytest.mark.parametrize("role", sorted(SIDECARS.keys() - {"lips"}))
def test_a_field_says_what_its_vectors_are(role):
    text = SIDECARS[role]
    assert json.loads(json.dumps(text)) == text
    assert text["Units"] == "mm" and text["VectorFrame"] == "LPS+" and "Outside" in text
    forward = "forward" in role
    assert text["Direction"] == ("input->output" if forward else "output->input")
    assert ("position minus resting" in text["Description"]) == forward
    assert ("OnTheCut" if forward else "InTheGap") in text


def test_numbers_in_the_words_are_those_of_the_code():
    assert f"{NOWHERE:.0f} mm" in SIDECARS["transform-extended"]["InTheGap"]
    assert SIDECARS["lips"]["LabelMap"] == {str(LEFT): "left lip", str(RIGHT): "right lip"}
