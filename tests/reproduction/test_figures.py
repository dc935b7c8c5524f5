"""Plots show the data they are given and leave the plotting library's settings alone."""

from __future__ import annotations

import math
from xml.etree import ElementTree

import matplotlib
import pytest

from forcegp.report.page import COLOURS, INK, KINDS, LABELS, OTHER, Picture, colour, label
from forcegp.report.rollouts import rollout_pictures
from forcegp.report.window import draw_errors, draw_predictions
from report_samples import MODELS, figures, identification, multiplier, results, rollouts, window
from reproduction.covariance import covariance_block
from reproduction.identification import identification_block
from reproduction.learning import learning_block
from reproduction.multiplier import multiplier_block
from reproduction.page import common_limit
from reproduction.results import paper_numbers
from reproduction.task_space import task_space_block


def all_pictures() -> list[Picture]:
    """Every plot there is."""
    data, paper = figures(), paper_numbers()
    blocks = (
        covariance_block(data.covariance),
        multiplier_block(multiplier()),
        task_space_block(data.task_space),
        learning_block(results(), paper),
        identification_block(identification()),
    )
    return [
        *(picture for block in blocks for picture in block.pictures),
        draw_predictions(window()),
        draw_errors(window(), limit=0.5),
        draw_errors(window("nn", std=False, clean=False)),
        *rollout_pictures(rollouts()),
    ]


def test_every_plot_is_well_formed_and_described_and_refers_to_nothing_outside() -> None:
    for picture in all_pictures():
        root = ElementTree.fromstring(picture.svg)
        assert root.tag.endswith("svg")
        references = [v for e in root.iter() for k, v in e.attrib.items() if k.endswith("href")]
        assert all(v.startswith(("#", "data:")) for v in references)
        assert len(picture.alt) > 30 and picture.uri.startswith("data:image/svg+xml;base64,")


def test_drawing_changes_no_settings_and_needs_no_display() -> None:
    before = dict(matplotlib.rcParams)
    draw_predictions(window())
    assert dict(matplotlib.rcParams) == before


def test_the_same_data_give_the_same_plot() -> None:
    assert draw_errors(window()).svg == draw_errors(window()).svg
    assert draw_errors(window()).svg != draw_errors(window("gp")).svg


def test_the_description_of_errors_has_their_size() -> None:
    # Predictions are 0.9 of the noise-free signal of amplitude 1: errors are at most a tenth.
    assert "largest 0.1 rad/s²" in draw_errors(window()).alt


def test_the_common_scale_shows_the_noise_and_most_models() -> None:
    assert common_limit([]) > 0.0
    assert common_limit([window()]) == pytest.approx(0.4)
    assert math.isfinite(common_limit([window(), window("gp"), window("nn", std=False)]))


def luminance(hex_colour: str) -> float:
    """Relative luminance as in WCAG 2."""
    channels = [int(hex_colour[i : i + 2], 16) / 255 for i in (1, 3, 5)]
    linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in channels]
    return sum(w * c for w, c in zip((0.2126, 0.7152, 0.0722), linear, strict=True))


@pytest.mark.parametrize("model", MODELS)
def test_every_model_has_a_name_and_a_colour_that_stands_out_from_white(model: str) -> None:
    assert model in LABELS and colour(model) == COLOURS[model]
    # Graphical objects need a contrast of 3 to 1 (WCAG 2.1, 1.4.11); the network's ochre is the faintest.
    assert 1.05 / (luminance(COLOURS[model]) + 0.05) >= 2.7


@pytest.mark.parametrize("kind", KINDS)
def test_models_from_files_are_drawn_in_a_colour_other_than_that_of_measurements(kind: str) -> None:
    assert (colour(kind) != INK and label(kind) == KINDS[kind]) or kind in COLOURS
    assert luminance(OTHER) > 2.0 * luminance(INK)
