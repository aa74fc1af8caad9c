"""The closed loop holds the force under every batched contact model."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

import meshskin as ms
from meshskin.contact import ContactModel
from meshskin.core.errors import ContactError, UnknownNameError
from meshskin.exploration.plan import plan_exploration

MODELS = [ContactModel(), ContactModel("elliptic"), ContactModel("layered", 0.47, 3e-3)]


@pytest.mark.parametrize("model", MODELS, ids=lambda m: m.name)
def test_the_slope_is_the_derivative_of_the_force(model):
    d, k = ca.SX.sym("d"), ca.SX.sym("k", 2)
    place = {"curvature": k, "indenter_radius": 0.01, "effective_modulus": 2.6e5}
    f = ca.Function("f", [d, k], [model.force(depth=d, **place), model.slope(depth=d, **place)])
    for depth in (2e-4, 1e-3, 2e-3):
        step = 1e-6 * depth
        above, below = (float(f(depth + s, [30.0, -5.0])[0]) for s in (step, -step))
        assert float(f(depth, [30.0, -5.0])[1]) == pytest.approx((above - below) / (2 * step), 1e-6)


@pytest.mark.parametrize(
    ("model", "mode"),
    [
        ("layered", "arm"),
        ("elliptic", "quasi_static"),
        pytest.param("elliptic", "arm", marks=pytest.mark.deep),
        pytest.param("layered", "quasi_static", marks=pytest.mark.deep),
    ],
)
def test_the_force_settles_at_its_reference(model, mode):
    scene = ms.Scene.load("sphere")
    scene = scene.with_(
        contact=model,
        material=replace(scene.material, thickness=4e-3 if model == "layered" else None),
        exploration=replace(scene.exploration, lane_spacing=0.02, margin=0.0),
        loop=replace(scene.loop, mode=mode),
    )
    recording = ms.simulate(scene)
    late = recording.force[len(recording.force) // 3 :]
    assert np.abs(late - 3.0).max() < 0.05
    depth = recording.motion["depth"].to_numpy()[-1]
    expected = scene.patch.depth
    assert depth == pytest.approx(expected, rel=0.01)


def test_auto_takes_the_first_model_that_holds():
    sphere = ms.Scene.load("sphere")
    assert sphere.with_(contact="auto").model.name == "hertz"
    thin = sphere.with_(contact="auto", material=replace(sphere.material, thickness=4e-3))
    assert thin.model.name == "layered"
    body = ms.Body.capsule(0.03, 0.2)
    skin = ms.Skin.cover(body, count=40, seed=1)
    assert sphere.with_(contact="auto", body=body, skin=skin).model.name == "elliptic"
    assert ms.Scene(body, skin).model.name == "elliptic"  # where none is named
    with pytest.raises(UnknownNameError, match="elliptic"):
        sphere.with_(contact="eliptic").model  # noqa: B018


@pytest.mark.deep
def test_a_model_that_does_not_hold_is_refused_or_its_places_left_out():
    sphere = ms.Scene.load("sphere")
    soft = sphere.with_(material=replace(sphere.material, young=2e4))
    with pytest.raises(ContactError, match="too wide"):
        ms.simulate(soft)
    body = ms.Body.capsule(0.03, 0.2)
    skin = ms.Skin.cover(body, spacing=24e-3, seed=1)
    scene = sphere.with_(
        body=body, skin=skin, loop=replace(sphere.loop, mode="quasi_static"),
        material=replace(sphere.material, young=8e5), contact="hertz",
    )  # fmt: skip
    side = scene.invalid_reasons(np.array([[33.3, 0.0], [33.3, 33.3]]))
    assert side[0].startswith("hertz contact does not hold: the relative principal")
    assert side[1] == ""
    assert (scene.with_(contact="elliptic").invalid_reasons(np.array([[33.3, 0.0]])) == "").all()
    missing = plan_exploration(scene).unreachable
    side = np.abs(skin.positions[:, 2]) < 0.08
    assert 0 < len(missing) < len(skin.ids)
    assert set(skin.ids[side]) <= set(missing)
    assert "hertz contact does not hold" in missing[int(skin.ids[side][0])]
