"""The sentences of an explanation, and their numbers at another seed."""

from __future__ import annotations

import dataclasses
import math
import re

import pytest
import results
import torch
from chance import allowed
from seeds import shifted

from scenecaptum import Camera, SceneRenderer, VanillaSceneGradient, metrics
from scenecaptum.attr import Explanation
from scenecaptum.estimation import TargetedMetric
from scenecaptum.explanation import explain, photometric_premises
from scenecaptum.explanation._changes import why_none
from scenecaptum.explanation._explain import _with_reflections
from scenecaptum.explanation._sources import find_sources
from scenecaptum.explanation._threshold import Lamps, edge_loss, lamp_edge_notes
from scenecaptum.rendering import SmallLamp
from scenecaptum.validation import Scenes
from scenecaptum.visualization import format_with_error, plot_bars, table_text


@pytest.fixture(scope="module")
def office() -> SceneRenderer:
    return SceneRenderer("office", "all", resolution=(64, 36), spp=128)


@pytest.fixture(scope="module")
def explained(office: SceneRenderer):
    return explain(office, metrics.MeanLuminance(), changes=3, seed=shifted())


def test_the_sky_matters_more_for_the_brightness_of_the_office_than_any_pane(explained):
    names = [row.name for row in explained.attribution.ranking()]
    sky = min(index for index, name in enumerate(names) if "sky" in name)
    panes = [index for index, name in enumerate(names) if "pane" in name]
    assert panes
    assert sky < min(panes)


def test_the_rendered_effects_hold_at_another_seed(office: SceneRenderer, explained):
    metric = metrics.MeanLuminance()
    scenes = Scenes(office, metric, None, seed=shifted(1000), spp=128, replicates=8)
    clear = [change for change in explained.changes if change.is_clear]
    assert clear
    for change in clear:
        differences = scenes.measure({change.name: change.after}) - scenes.unmodified
        error = math.hypot((differences.std() / math.sqrt(len(differences))).item(), change.measured_error)
        z = (differences.mean().item() - change.measured) / error
        assert abs(z) < allowed(len(clear), 7), change.name


def test_a_change_knows_the_replicates_of_its_errors():
    renderer = SceneRenderer("cornell-box", "reflectance", resolution=(8, 8), spp=32, max_depth=3)
    found = explain(renderer, metrics.MeanLuminance(), changes=1, replicates=4, seed=shifted())
    assert [change.degrees_of_freedom for change in found.changes] == [3]


def test_an_explanation_says_why_no_change_is_proposed():
    renderer = SceneRenderer("cornell-box", "reflectance", resolution=(8, 8), spp=8, max_depth=2)

    def constant(image: torch.Tensor) -> torch.Tensor:
        return 0 * image.sum()

    reason = "no change is proposed: every predicted effect is 0"
    found = explain(renderer, constant, changes=1, seed=shifted())
    assert reason in " ".join(found.text().split())
    assert reason in found.markdown()
    assert "no change" not in explain(renderer, constant, changes=0, seed=shifted()).text()
    covariance = {name: matrix + 1.0 for name, matrix in found.attribution.covariance.items()}
    noisy = why_none(dataclasses.replace(found.attribution, covariance=covariance))
    assert noisy == "no change is proposed: no single one has a predicted effect that is clear of its noise"
    one = why_none(dataclasses.replace(found.attribution, covariance=None, standard_error=None))
    assert one == "no change is proposed: every predicted effect is 0"
    clear = dataclasses.replace(
        found.attribution, attributions={name: 1.0 + value for name, value in found.attribution.items()}
    )
    said = "what has a clear effect is part of the construction, off, or as far as it can go"
    assert why_none(clear) == f"no change is proposed: {said}"
    unknown = why_none(dataclasses.replace(clear, covariance=None, standard_error=None))
    assert unknown == "no change is proposed: without error bars no effect is known to be clear of its noise"


def test_only_moves_along_the_floor_and_turns_about_the_vertical_are_said_to_be_unclear():
    poses = [f"short_box_shape.pose.{component}" for component in ("translation", "rotation")]
    wall, size = "short_box.reflectance.value", "short_box_shape.pose.scale"
    renderer = SceneRenderer("cornell-box", [*poses, wall, size], resolution=(8, 8), spp=8, max_depth=2)
    found = VanillaSceneGradient(renderer, metrics.MeanLuminance()).attribute(seed=shifted())
    lifted = torch.eye(3)[renderer.up]
    effects = {poses[0]: lifted, poses[1]: torch.ones(3) - lifted}

    def why(*names: str, clear: str = "") -> str:
        chosen = {**effects, wall: torch.zeros(3), size: torch.zeros(())}
        return why_none(
            dataclasses.replace(
                found,
                attributions={name: chosen[name] + float(name == clear) for name in names},
                covariance={name: 1e-3 * torch.eye(chosen[name].numel()) for name in names},
                info={**found.info, "jumps": {}, "kept_directions": {}},
            )
        ).removeprefix("no change is proposed: ")

    noisy = "has a predicted effect that is clear of its noise"
    move, turn = "no move along the floor", "no turn about the vertical"
    assert why(*poses) == f"{move} and {turn} {noisy}"
    assert why(poses[0]) == f"{move} {noisy}"
    assert why(poses[1]) == f"{turn} {noisy}"
    assert why(*poses, wall) == f"{move}, {turn} and no change of another parameter {noisy}"
    assert why(wall, size) == f"no single one {noisy}"
    fixed = "what has a clear effect is part of the construction, off, or as far as it can go"
    assert why(poses[0], wall, clear=wall) == f"{fixed}, and {move} {noisy}"
    assert why(wall, clear=wall) == fixed


def test_no_change_is_proposed_where_nothing_counts_as_a_glare_source():
    renderer = SceneRenderer("cornell-box", "all", resolution=(8, 8), spp=8, max_depth=2)
    dim = metrics.UnifiedGlareRating(renderer.camera, threshold=1e9)
    text = " ".join(explain(renderer, dim, changes=2, seed=shifted()).text().split())
    reason = "nothing counts as a glare source, so that no small change affects the rating"
    assert f"What would change it no change is proposed: {reason}" in text
    assert "noise" not in text


def test_only_effects_that_are_clear_of_the_noise_are_stated(explained):
    text = explained.text(width=100)
    assert text.startswith("mean luminance = ")
    assert "cd/m²" in text.splitlines()[0]
    for row in explained.attribution.ranking():
        if abs(row.effect) <= 2 * row.effect_error:
            assert row.label not in text.split("Too noisy to say")[0]
    assert all(len(line) <= 100 for line in text.splitlines())


def test_a_result_explains_itself_without_rendering(office: SceneRenderer):
    metric = metrics.UnifiedGlareRating(office.camera)
    attribution = VanillaSceneGradient(office, metric).attribute(seed=shifted(), spp=32)
    text = attribution.explain().text()
    assert text.startswith("unified glare rating = ")
    assert "EN 12464-1" in text.split("\n\n")[0].replace("\n", " ")
    assert "rendered again" not in text


def test_the_seed_that_was_given_stands_beside_the_one_of_the_attribution(explained):
    info = explained.attribution.info
    assert info["explanation_seed"] == shifted()
    assert info["seed"] != info["explanation_seed"]


def test_glare_sources_are_named_by_their_objects(office: SceneRenderer):
    found = explain(office, metrics.UnifiedGlareRating(office.camera), changes=0, spp=64, seed=shifted())
    assert sum(source.share for source in found.sources) <= 1 + 1e-6
    assert found.sources
    owners = {label.rpartition(": ")[0] for label in found.attribution.labels.values()}
    assert all(source.name in {*owners, *found.attribution.surfaces.objects} for source in found.sources)
    assert found.sources[0].name == "sky"  # seen through the panes
    assert "Where the glare comes from" in found.markdown()


def test_a_texture_changes_within_its_bounds(office: SceneRenderer, explained):
    for change in explained.changes:
        low, high = office.bounds[change.name]
        assert (change.after >= low).all()
        assert (change.after <= high).all()
        assert not torch.equal(change.before, change.after)


@pytest.mark.long
def test_objects_are_moved_along_the_floor_and_turned_about_the_vertical(mi):
    poses = ["short_box_shape.pose.translation", "short_box_shape.pose.rotation"]
    box = SceneRenderer("cornell-box", poses, resolution=(16, 16), spp=64, max_depth=3)
    assert box.up == 2
    found = explain(box, metrics.MeanLuminance(), changes=2, seed=shifted())
    moved = {change.name: change.after for change in found.changes}
    assert moved
    lengths = found.attribution.weights("range")
    for name, pose in moved.items():
        vertical, across = abs(pose[2].item()), pose[:2].norm().item()
        along, other = (vertical, across) if "rotation" in name else (across, vertical)
        assert other == 0
        assert along == pytest.approx(lengths[name].norm().item() / 2, rel=1e-4)


def test_changes_go_towards_the_goal(mi):
    box = SceneRenderer("cornell-box", "light.emitter.radiance.value", resolution=(8, 8), spp=16, max_depth=2)
    raised, lowered = (
        explain(box, metrics.MeanLuminance(), changes=1, below=below, seed=shifted()).changes[0]
        for below in (None, 1e6)
    )
    assert raised.predicted > 0
    assert lowered.predicted < 0


@pytest.mark.long
@pytest.mark.parametrize("run", [0, 1, 2])
def test_the_prediction_of_a_dimmed_map_has_the_error_of_its_scale(mi, run: int):
    texels = torch.rand(16, 32, 3, generator=torch.Generator().manual_seed(shifted(run)))
    scene = {
        "type": "scene",
        "view": {
            "type": "perspective",
            "to_world": mi.ScalarTransform4f().look_at([0, -3, 1], [0, 0, 0], [0, 0, 1]),
        },
        "floor": {"type": "rectangle", "bsdf": {"type": "diffuse"}},
        "sky": {"type": "envmap", "bitmap": mi.Bitmap(texels.pow(4).numpy())},
    }
    errors = []
    for name in ("sky.data", "sky.scale"):
        renderer = SceneRenderer(scene, name, resolution=(8, 8), spp=16, max_depth=3)
        (change,) = explain(renderer, metrics.MeanLuminance(), changes=1, seed=shifted(run)).changes
        errors.append(change.predicted_error)
    assert errors[0] == pytest.approx(errors[1], rel=0.2)


def test_a_goal_is_reached_by_the_leading_parameter_alone_if_that_is_enough(mi):
    inputs = ["floor.reflectance.value", "light.emitter.radiance.value"]
    box = SceneRenderer("cornell-box", inputs, resolution=(16, 16), spp=64, max_depth=3)
    metric = metrics.MeanLuminance()
    value = metric(box(seed=shifted(), spp=1024)).item()
    easy, hard = (
        explain(box, metric, changes=0, below=part * value, seed=shifted(1)).goal for part in (0.8, 0.45)
    )
    assert [moved.name for moved in easy.moved] == ["light.emitter.radiance.value"]
    assert easy.reached
    assert len(hard.moved) == 2


@pytest.mark.long
def test_a_daylight_glare_probability_outside_its_range_has_a_caution_with_the_illuminance():
    eye = SceneRenderer("office", "emitters", sensor="fisheye", resolution=(24, 24), spp=16, max_depth=3)
    dgp = metrics.DaylightGlareProbability(eye.camera)
    lit = explain(eye, dgp, changes=0).notes()
    assert any(note.startswith("vertical illuminance at the eye: ") for note in lit)
    assert not any("caution: DGP is valid" in note for note in lit)
    dark = {name: value / 10 for name, value in eye.inputs.items()}
    (caution,) = [note for note in explain(eye, dgp, dark, changes=0).notes() if "DGP is valid" in note]
    assert caution.startswith(
        "caution: DGP is valid from 0.2 to 0.8, and above 380 lx at the eye; here DGP is 0.1"
    )
    assert caution.endswith(" lx")


def test_a_picture_without_a_glare_source_says_so_with_its_brightest_pixel():
    camera = Camera.perspective(16, 16, fov_x=60)
    image = torch.full((16, 16, 3), 0.5)
    metric = metrics.UnifiedGlareRating(camera)
    (note,) = [one for one in photometric_premises(metric, image, 0.0, None) if "no pixel" in one]
    assert note.startswith("no pixel is brighter than 2000 cd/m² (the brightest: 89.5 cd/m²): nothing counts")
    assert note.endswith("a threshold factor of 5")


def test_the_illuminance_from_within_a_narrow_view_says_so():
    def said(camera: Camera) -> list[str]:
        metric = metrics.VerticalIlluminance(camera)
        return [
            one
            for one in photometric_premises(metric, torch.ones(8, 8, 3), 1.0, None)
            if "field of view" in one
        ]

    (note,) = said(Camera.perspective(8, 8, fov_x=66.2))
    assert note.startswith("only light from within the camera's field of view of 66° counts; ")
    assert "fisheye camera" in note
    assert said(Camera.fisheye(8, 8)) == []


def test_only_a_source_that_is_close_to_an_absolute_threshold_has_a_note():
    camera = Camera.perspective(16, 16, fov_x=60)

    def has_note(luminance: float, **options: float) -> bool:
        image = torch.full((16, 16, 3), 0.5)
        image[4:6, 7:9] = luminance / 179
        premises = photometric_premises(metrics.UnifiedGlareRating(camera, **options), image, 10.0, None)
        return any(note.startswith("only pixels brighter than 2000 cd/m² count") for note in premises)

    assert has_note(4000.0)
    assert not has_note(20000.0)
    assert not has_note(4000.0, threshold_factor=5.0)


@pytest.mark.parametrize(("error", "decimals"), [(0.2, 2), (0.012, 3), (3.0, 1), (0.5, 1)])
def test_the_rating_by_the_other_threshold_has_the_decimals_of_the_one_it_stands_beside(
    error: float, decimals: int
) -> None:
    image = torch.full((16, 16, 3), 0.5)
    image[4:6, 7:9] = 4000.0 / 179
    metric = metrics.UnifiedGlareRating(Camera.perspective(16, 16, fov_x=60))
    (note,) = [one for one in photometric_premises(metric, image, 24.7, error) if "UGR is" in one]
    assert len(note.rpartition(".")[2]) == decimals
    assert len(format_with_error(24.7, error).split()[0].rpartition(".")[2]) == decimals


@pytest.mark.parametrize(
    ("factor", "jumps"), [(4.9, True), (5.0, True), (5.1, True), (6.0, False), (4.0, False)]
)
def test_the_rating_by_the_other_threshold_says_where_it_jumps(factor: float, jumps: bool) -> None:
    """A source that is as bright as the threshold counts or not by chance: the sentence has both ratings."""
    window, bulb = (slice(4, 8), slice(4, 12)), (slice(12, 13), slice(8, 9))
    camera = Camera.perspective(16, 16, fov_x=60)
    image = torch.full((16, 16, 3), 1.0)
    image[bulb] = 40.0
    shares = camera.solid_angles / camera.solid_angles.sum()
    share = shares[window].sum().item()  # of the view: the window raises the mean luminance itself
    rest = (shares * image[..., 0]).sum().item() - share
    level = factor * rest / (1 - factor * share)
    image[window] = level
    metric = metrics.UnifiedGlareRating(camera, threshold=0.5 * 179 * level)
    (note,) = [one for one in photometric_premises(metric, image, 20.0, 0.1) if "UGR is" in one]
    low, high = (metric.relative_to_mean(other).hard(image).item() for other in (5 * 1.03, 5 * 0.97))
    assert (" within 3 % of that threshold" in note) == jumps, note
    if jumps:
        assert f"({low:.2f} to {high:.2f} within" in note, "as precise as the rating"
        assert high > low + 1.0


class _Firefly:
    """A dim room of which the first picture, and no other, has one very bright pixel."""

    inputs = {"paint": torch.tensor(0.5)}  # noqa: RUF012 -- read only

    def __init__(self) -> None:
        self.seed: int | None = None

    def __call__(self, inputs, *, seed=0, spp=None):
        self.seed = seed if self.seed is None else self.seed
        bright = torch.zeros(16, 16, 3)
        bright[8, 8] = 1000.0 * (seed == self.seed)
        return inputs["paint"] * torch.ones(16, 16, 3) + bright


def test_the_notes_on_a_rating_are_of_the_picture_of_its_value():
    """The value has a source: it must not be said that there is none, but that a single sample makes it."""
    camera = Camera.fisheye(16, 16)
    notes = explain(_Firefly(), metrics.DaylightGlareProbability(camera), changes=0, denoise=False).notes()
    assert not any("no pixel is brighter" in note for note in notes)
    (caution,) = [note for note in notes if "single samples" in note]
    assert "in another render its pixels have 89.5 cd/m²" in caution
    lit = _Firefly()
    lit.seed = -1
    lit.inputs = {"paint": torch.tensor(50.0)}
    notes = explain(lit, metrics.DaylightGlareProbability(camera), changes=0, denoise=False).notes()
    assert not any("single samples" in note for note in notes)


class _NoisyWindow:
    """A room with a window near the threshold, whose luminance has much noise."""

    inputs = {"paint": torch.tensor(0.5)}  # noqa: RUF012 -- read only

    def __call__(self, inputs, *, seed=0, spp=None):
        generator = torch.Generator().manual_seed(seed)
        picture = torch.ones(16, 16, 3)
        picture[4:6, 7:9] = 2 * 2000 / 179 * (0.8 * torch.randn((), generator=generator)).exp()
        return inputs["paint"] * picture


def test_the_caution_on_noise_says_that_it_is_of_the_relaxed_value():
    rating = metrics.UnifiedGlareRating(Camera.perspective(16, 16, fov_x=60))
    found = explain(_NoisyWindow(), rating, changes=0, denoise=False)
    assert found.definition is not None
    caution, *others = found.notes()
    assert caution.startswith(
        "caution: the picture is too noisy for the relaxed value: its 95 % interval is ± "
    )
    assert not any(note.startswith("quote") for note in others)


@pytest.mark.parametrize("lamp", ["point", pytest.param("spot", marks=pytest.mark.long)])
def test_a_room_of_point_lamps_has_no_glare_source_and_no_class(mi, stage_dict, lamp: str):
    """A rating of 0 is no finding that there is little glare: its lamps have no area, and are not rated."""
    dark = {name: stage_dict[name] for name in ("type", "camera", "ball", "ground")}
    above = mi.ScalarTransform4f().look_at(origin=[0, 0, 4], target=[0, 0, 0], up=[0, 1, 0])
    lit = {**dark, "bulb": {"type": lamp, "intensity": {"type": "rgb", "value": 1.0}, "to_world": above}}
    renderer = SceneRenderer(lit, "reflectance", resolution=(8, 8), spp=8, max_depth=3)
    for metric in (metrics.UnifiedGlareRating(renderer.camera), metrics.DaylightGlareIndex(renderer.camera)):
        said = explain(renderer, metric, changes=0, seed=shifted())
        assert said.attribution.metric_value == 0
        assert said.rating() == "no glare source found"
        assert sum("point, spot and IES lamps have no area" in note for note in said.notes()) == 1
        assert sum("check the scene's units" in note for note in said.notes()) == 1


def bulb_before_a_wall(mi, width: int, radius: float, spp: int = 64, radiance: float = 60.0) -> SceneRenderer:
    transform = mi.ScalarTransform4f()
    lamp = {"type": "area", "radiance": {"type": "rgb", "value": radiance}}
    scene = {
        "type": "scene",
        "camera": {
            "type": "perspective",
            "fov": 60,
            "to_world": transform.look_at(origin=[0, 0, 4], target=[0, 0, 0], up=[0, 1, 0]),
            "film": {"type": "hdrfilm", "rfilter": {"type": "box"}},
        },
        "wall": {"type": "rectangle", "to_world": transform.translate([0, 0, -1]).scale(9)},
        "bulb": {"type": "sphere", "radius": radius, "center": [0.3, 0.2, 0], "emitter": lamp},
    }
    return SceneRenderer(scene, "emitters", resolution=(width, width), spp=spp, max_depth=2)


@pytest.mark.parametrize(("width", "radius"), [(8, 0.1), (8, 0.003)])
def test_a_lamp_smaller_than_half_a_pixel_is_cautioned(mi, width: int, radius: float):
    """Its pixel is averaged with the dark around it: no glare source, and no ray of its map meets the smaller."""
    renderer = bulb_before_a_wall(mi, width, radius)
    metric, image = metrics.UnifiedGlareRating(renderer.camera), renderer(seed=shifted())
    notes = photometric_premises(metric, image, metric(image).item(), 0.1, renderer=renderer)
    assert sum("caution: pixels at the edges of bulb average its light" in note for note in notes) == 1
    assert any("nothing counts as a glare source" in note for note in notes)
    assert not any("check the scene's units" in note for note in notes), "its size is why"


def test_a_source_that_is_smaller_than_a_pixel_is_named_after_its_lamp(mi):
    """No ray of a pixel's map meets it, and the pixel shows little but the wall."""
    renderer = bulb_before_a_wall(mi, 16, 0.003, radiance=2e6)
    metric = TargetedMetric(metrics.UnifiedGlareRating(renderer.camera), None)
    images = torch.stack([renderer(seed=shifted(seed), spp=256) for seed in range(4)])
    assert "bulb" not in {source.name for source in find_sources(metric, images, renderer.surfaces)}
    sources = find_sources(metric, images, renderer.surfaces, renderer.small_lamps())
    assert sources[0].name == "bulb"
    assert sources[0].share > 0.9


def test_what_a_rating_lacks_is_what_a_finer_picture_has_more(mi):
    """At 8 pixels the lamp covers less than half of any, at 32 and 64 most of one, at 512 it is 11 wide."""

    def rated(width: int, spp: int) -> tuple[float, str]:
        renderer = bulb_before_a_wall(mi, width, 0.1, spp)
        metric, image = metrics.UnifiedGlareRating(renderer.camera), renderer(seed=shifted())
        found = lamp_edge_notes(metric, image, Lamps.of(renderer))
        return metric.hard(image).item(), "".join(found)

    said = {width: rated(width, spp) for width, spp in ((8, 64), (32, 4096), (64, 1024), (128, 64), (512, 4))}
    missing = {
        width: float(found[1]) if (found := re.search(r"too low, by about ([\d.]+)", note)) else 0.0
        for width, (_, note) in said.items()
    }
    whole = {width: value + missing[width] for width, (value, _) in said.items()}
    assert whole[128] == pytest.approx(whole[512], abs=8 * math.log10(1.1))
    for width in (8, 32, 64):
        # Its map has 16 rays in each of the few pixels that show it, and those of a coarse picture are elsewhere.
        assert whole[width] == pytest.approx(whole[512], abs=8 * math.log10(1.3))
    assert said[8][1].startswith("caution: ")
    assert said[128][1].startswith("pixels at the edges of bulb average"), "less is missing"
    assert missing[512] == 0, "not worth a note"


def camera_at_four(transform) -> dict[str, object]:
    """A camera at z = 4 that looks at the origin, whose pixels are averages of their own light alone."""
    return {
        "type": "perspective",
        "fov": 60,
        "to_world": transform.look_at([0, 0, 4], [0, 0, 0], [0, 1, 0]),
        "film": {"type": "hdrfilm", "rfilter": {"type": "box"}},
    }


def test_what_a_window_to_the_sky_lacks_is_what_a_finer_picture_has_more(mi):
    """Also behind a pane, which reflects the dark room."""
    transform = mi.ScalarTransform4f()
    pieces = {"left": (-5.3, 0.2), "right": (5.9, 0.2), "below": (0.3, -5.2), "above": (0.3, 5.6)}
    scene = {
        "type": "scene",
        "camera": camera_at_four(transform),
        "sky": {"type": "constant", "radiance": 40.0},
        "pane": {"type": "rectangle", "bsdf": {"type": "thindielectric"}},
    }
    for name, (x, y) in pieces.items():
        black = {"type": "diffuse", "reflectance": 0.01}
        place = transform.translate([x, y, 0.01]).scale(5)
        scene[name] = {"type": "rectangle", "to_world": place, "bsdf": black}

    def rated(width: int, spp: int) -> tuple[float, float]:
        renderer = SceneRenderer(scene, "emitters", resolution=(width, width), spp=spp, max_depth=3)
        metric, image = metrics.UnifiedGlareRating(renderer.camera), renderer(seed=shifted())
        assert renderer.small_lamps() == {}
        return metric.hard(image).item(), edge_loss(metric, image, Lamps.of(renderer)).missing

    (fine, rest), *coarse = (rated(width, spp) for width, spp in ((256, 16), (32, 1024), (20, 1024)))
    assert rest < 0.2
    for value, missing in coarse:
        assert missing > 0.2
        assert value + missing == pytest.approx(fine + rest, abs=8 * math.log10(1.1))


@pytest.mark.parametrize("width", [16, 24, 32])
def test_with_what_a_reflection_lacks_a_rating_is_that_of_the_reflection(mi, width: int):
    """Of a lamp behind the camera that a pane reflects in less than a pixel; also where a denoiser takes it."""
    transform = mi.ScalarTransform4f()
    radiance, radius, place = 600.0, 0.15, [0.8, 0.5, 6.0]
    scene = {
        "type": "scene",
        "camera": camera_at_four(transform),
        "pane": {"type": "rectangle", "bsdf": {"type": "thindielectric"}},
        "outside": {"type": "rectangle", "to_world": transform.translate([0, 0, -2]).scale(9)},
        "dusk": {"type": "constant", "radiance": 0.1},
        "floor_lamp": {
            "type": "sphere",
            "radius": radius,
            "center": place,
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": radiance}},
        },
    }
    renderer = SceneRenderer(scene, "emitters", resolution=(width, width), spp=1024, max_depth=4)
    metric, image, lamps = (
        metrics.UnifiedGlareRating(renderer.camera),
        renderer(seed=shifted()),
        Lamps.of(renderer),
    )
    without = image.clone()
    is_lamp = lamps.reflected["floor_lamp"].fraction > 0
    without[is_lamp] = image[~is_lamp].mean(0)
    # As a picture of many pixels has it: a disc in the direction of the mirror image, at 2/26 of the luminance.
    finer = Camera.perspective(512, 512, fov_x=60)
    to_image = torch.tensor([place[0], place[1], place[2] + 4]).double()
    is_disc = finer.directions @ to_image / to_image.norm() > math.cos(radius / to_image.norm())
    picture = torch.where(is_disc[..., None], radiance / 13, image[~is_lamp].mean(0).double())
    expected = metrics.UnifiedGlareRating(finer).hard(picture).item()
    for shown in (image, without):
        loss = edge_loss(metric, shown, lamps)
        assert loss.lamps == ["the reflection of floor_lamp"]
        assert loss.reflections == ("the reflection of floor_lamp",)
        assert metric.hard(shown).item() + loss.missing == pytest.approx(expected, abs=8 * math.log10(1.3))
    # A few samples that meet the lamp are the lamp's light, not that of the dark objects in these pixels.
    noisy = without.where(~is_lamp[..., None], 60.0).expand(2, -1, -1, -1)
    seen, light = renderer.see_through(()), _with_reflections({}, lamps.reflected)
    source, *_ = find_sources(TargetedMetric(metric, None), noisy, seen, {}, light, loss.reflected)
    assert source.name == "floor_lamp"
    assert source.share > 0.8
    (note,) = lamp_edge_notes(metric, without, lamps)
    assert note.startswith("caution: pixels at the edges of the reflection of floor_lamp average its light")
    assert "(then above 19, the limit for offices; within 22" in note
    assert note.endswith("use a higher resolution and more samples")


def test_a_change_with_what_lamps_lack_is_that_of_a_finer_picture(mi):
    """Dimmed below the threshold, the lamp counts no more; its pixels, of half its light, never did."""
    radiance, spp = 14.0, 256
    coarse, fine = (
        bulb_before_a_wall(mi, 32, 0.1, spp, radiance),
        bulb_before_a_wall(mi, 512, 0.1, 4, radiance),
    )
    glare = metrics.UnifiedGlareRating(coarse.camera)
    (change,) = explain(coarse, glare, changes=1, seed=shifted()).changes
    dimmed = {change.name: change.after}
    rated = metrics.UnifiedGlareRating(fine.camera)
    before, after = (rated.hard(fine(values, seed=shifted())).item() for values in ({}, dimmed))
    assert change.exact == 0
    assert change.missing == pytest.approx(after - before, abs=8 * math.log10(1.3))
    other = metrics.UnifiedGlareRating(coarse.camera, threshold_factor=5)
    before, after = (other.hard(coarse(values, seed=shifted(), spp=4096)).item() for values in ({}, dimmed))
    assert change.relative == pytest.approx(after - before, abs=8 * math.log10(1.05))


def test_only_lamps_that_lose_much_are_named():
    metric = metrics.UnifiedGlareRating(Camera.perspective(8, 8, fov_x=60))
    image = torch.full((8, 8, 3), 0.5)
    covered = {"half": torch.zeros(8, 8), "whole": torch.zeros(8, 8), "dim": torch.zeros(8, 8)}
    covered["half"][2, 3:5], covered["whole"][4, 3:5], covered["dim"][6, 3:5] = 0.5, 1.0, 0.5
    image[2, 3:5], image[4, 3:5], image[6, 3:5] = 150.0, 150.0, 20.0
    (note,) = lamp_edge_notes(metric, image, Lamps({}, covered, {}))
    assert "pixels at the edges of half average its light with what is around it" in note
    # Two halves of a pixel of 300 are one of it, in place of two of 150.
    image[6, 3:5] = 0.5
    resolved = image.clone()
    resolved[2, 3:5] = 300.0 / 2**0.5
    missing = metric.hard(resolved).item() - metric.hard(image).item()
    (note,) = lamp_edge_notes(metric, image, Lamps({}, covered, {}))
    assert float(re.search(r"by about ([\d.]+)", note)[1]) == pytest.approx(missing, rel=0.05)


def test_small_lamps_in_one_pixel_add_up():
    metric = metrics.UnifiedGlareRating(Camera.perspective(8, 8, fov_x=60))
    image = torch.full((8, 8, 3), 0.5)

    def said(*solid_angles: float) -> list[str]:
        lamps = {
            str(n): SmallLamp(torch.full((3,), 300.0), one, (3, 4)) for n, one in enumerate(solid_angles)
        }
        return [note.split("by about ")[1] for note in lamp_edge_notes(metric, image, Lamps(lamps, {}, {}))]

    assert said(1e-5, 1e-5) == said(2e-5) != said(1e-5)


def test_without_small_lamps_nothing_is_missing_from_a_negative_rating():
    metric = metrics.UnifiedGlareRating(Camera.perspective(8, 8, fov_x=60), threshold_factor=1.01)
    image = torch.full((8, 8, 3), 1e-4)
    image[3, 4] = 2e-4
    assert metric.hard(image) < 0
    assert lamp_edge_notes(metric, image, Lamps({}, {}, {})) == []


def test_a_noisy_uniformity_is_cautioned():
    """Also where few samples find the light of a lamp: the darkest point may lack it in all replicates."""
    metric, image = metrics.Uniformity(), torch.ones(4, 8, 3)
    said = [
        "".join(photometric_premises(metric, image, 0.3, error, is_doubted=is_doubted))
        for error, is_doubted in ((0.02, False), (0.01, False), (0.01, True))
    ]
    assert ["noise lowers the smallest illuminance" in text for text in said] == [True, False, True]


def test_a_room_of_other_lamps_has_a_class():
    box = SceneRenderer("cornell-box", "reflectance", resolution=(8, 8), spp=8, max_depth=3)
    said = explain(box, metrics.UnifiedGlareRating(box.camera, threshold=1.0), changes=0, seed=shifted())
    assert said.rating() != "no glare source found"
    assert not any("IES lamps" in note for note in said.notes())


def test_without_a_source_a_daylight_glare_probability_keeps_its_class():
    """It is that of the illuminance at the eye."""
    camera = Camera.fisheye(16, 16)
    image = torch.full((16, 16, 3), 0.5)
    probability, index = metrics.DaylightGlareProbability(camera), metrics.DaylightGlareIndex(camera)
    assert not probability.unrated(image)
    assert index.unrated(image) == "no glare source found"


def test_a_relaxed_rating_in_another_class_than_its_definition_names_that_class():
    """In the table, in the titles of figures and on the card of a report; elsewhere the class stands alone."""
    camera = Camera.perspective(16, 16, 60.0)
    bright = torch.zeros(16, 16, 3) + 0.05
    bright[4:8, 4:8] = 2000.0 / 179.0 * 1.08  # counts by half if relaxed, and whole by the definition
    rating = metrics.UnifiedGlareRating(camera, relaxation=0.3)
    exact = rating.hard(bright).item()
    targeted = TargetedMetric(rating)
    said = targeted.describe(rating(bright).item(), bright)
    above = rating.measure.verdict(exact)
    assert rating.measure.verdict(rating(bright).item()) != above
    assert said["relaxed"]
    assert said["verdict"] == f"relaxed; by the definition {exact:.4g}: {above}"
    result = results.make(**said)
    assert "relaxed; by the definition" in table_text(result)
    assert ", relaxed" in results.all_text(plot_bars(result))
    assert Explanation(result).rating() == said["verdict"], (
        "without the source of the classes of the other value"
    )
    close = rating(bright / 1.06), rating.hard(0.9 * bright), exact
    low, high = (f"{value:.4g}" for value in (close[1].item(), rating.hard(bright / 1.06).item()))
    assert rating.unrated(bright / 1.06) == (
        f"relaxed; by the definition {low} to {high}: pixels are within 5 % of the threshold"
    )
    alike = metrics.UnifiedGlareRating(camera, threshold=500.0)
    assert not TargetedMetric(alike).describe(alike(bright).item(), bright)["relaxed"]
    assert ", relaxed" not in results.all_text(plot_bars(results.make()))
