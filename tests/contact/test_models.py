"""All contact models: upgrades, batches of contacts, CasADi expressions, ranges."""

import casadi as ca
import numpy as np
import pytest

from meshskin import Body, contact
from meshskin.contact import BATCHED
from meshskin.contact.material import Indentation, Material
from meshskin.core.errors import ContactError, UnknownNameError
from meshskin.geometry.surface.patch import casadi_foot

CASE = {
    "force": 1.0,
    "curvature": 10.0,
    "indenter_radius": 0.01,
    "modulus": 0.5e6,
    "poisson": 0.45,
}


@pytest.mark.parametrize(
    ("change", "model"),
    [
        ({}, "hertz"),
        ({"thickness": 0.1}, "hertz"),
        ({"curvature": (30.0, 0.0)}, "elliptic"),
        ({"thickness": 4e-3}, "layered"),
        ({"thickness": 4e-3, "curvature": (30.0, 0.0)}, "layered"),
        ({"thickness": 4e-3, "poisson": -0.2}, "field"),
        ({"thickness": 4e-3, "curvature": (300.0, 0.0)}, "field"),
        ({"modulus": 0.02e6}, "field"),
    ],
)
def test_upgrade_uses_the_next_valid_model(change, model):
    case = CASE | change
    patch = contact.solve("hertz", upgrade=True, **case)
    assert patch.model == model
    assert patch.peak == contact.solve(model, **case).peak
    if model != "hertz":
        with pytest.raises(ContactError, match="limit"):
            contact.solve("hertz", **case)


@pytest.mark.parametrize("model", contact.BATCHED)
def test_slope_is_the_derivative_of_force(model):
    law, depth, step = contact.ContactModel(model, poisson=0.45, thickness=3e-3), 2e-4, 1e-7
    given = {
        "curvature": np.array([12.0, 8.0]), "indenter_radius": 0.01, "effective_modulus": 0.6e6,
    }  # fmt: skip
    change = law.force(depth=depth + step, **given) - law.force(depth=depth - step, **given)
    x, symbols = ca.SX.sym("x"), given | {"curvature": ca.DM([12.0, 8.0])}
    slope = ca.Function("slope", [x], [law.slope(depth=x, **symbols)])
    assert float(slope(depth)) == pytest.approx(change / (2 * step), rel=1e-6)
    if model != "layered":
        assert law.slope(depth=depth, **given) == pytest.approx(float(slope(depth)), rel=1e-12)


@pytest.mark.parametrize("model", contact.BATCHED)
def test_casadi_clips_hollows_at_a_thousandth_of_the_tip_curvature(model):
    law, k = contact.ContactModel(model, poisson=0.45, thickness=1.0), ca.SX.sym("k", 2)
    given = {"depth": 1e-5, "indenter_radius": 0.01, "effective_modulus": 0.6e6}
    f = ca.Function("f", [k], [law.force(curvature=k, **given)])
    assert np.isfinite(float(f([-300.0, -300.0])))
    if model == "hertz":  # the mean curvature alone is positive
        assert float(f([-110.0, 0.0])) == pytest.approx(float(f([-55.0, -55.0])))
        return
    clipped = law.force(curvature=np.array([-99.9, 0.0]), **given)
    assert float(f([-110.0, 0.0])) == pytest.approx(clipped, rel=1e-9)


@pytest.mark.parametrize("poisson", [0.0, 0.3, 0.5])
def test_half_space_at_its_limit_of_thickness(poisson):
    """At a = thickness / 10 the approach on a layer is at most 7.5 % smaller."""
    case = CASE | {"poisson": poisson}
    patch = contact.solve("hertz", **case)
    limit = 10 * float(patch.semi_axes[0])
    assert contact.solve("hertz", thickness=1.001 * limit, **case).depth == patch.depth
    with pytest.raises(ContactError, match=r"a/thickness = 0.1, limit: 0\.1"):
        contact.solve("hertz", thickness=0.999 * limit, **case)
    layer = contact.solve("layered", thickness=limit, **case)
    assert 0.924 < layer.depth / patch.depth < 0.95
    assert layer.semi_axes == pytest.approx(patch.semi_axes, rel=1e-3)


def test_upgrade_starts_at_the_given_model():
    assert contact.solve("layered", upgrade=True, **CASE).model == "layered"


@pytest.mark.parametrize(
    ("change", "names"),
    [
        ({"force": -1.0}, "force is out of range"),
        ({"modulus": np.inf}, "modulus must be a finite number"),
        ({"curvature": -120.0}, "hollow"),
        ({"modulus": 2e2}, "indenter radius"),
        ({"thickness": 1e-5}, "thickness/cell"),
    ],
)
def test_upgrade_without_a_valid_model_raises(change, names):
    with pytest.raises(ContactError, match=names):
        contact.solve("hertz", upgrade=True, **CASE | change)


@pytest.mark.parametrize("model", contact.BATCHED)
@pytest.mark.parametrize("thickness", [None, 3e-3])
def test_batch_equals_single_contacts(model, thickness):
    rng = np.random.default_rng(0)
    push = rng.uniform(0.1, 0.4, 6)
    curvature = np.repeat(rng.uniform(-20, 20, (6, 1)), 2, axis=1)
    if model != "hertz":
        curvature[:, 0] += 30.0
    law = contact.ContactModel(model, poisson=0.45, thickness=thickness)
    geometry = {"curvature": curvature, "indenter_radius": 0.01}
    e_star = 0.5e6 / (1 - 0.45**2)
    many = law.patches(force=push, effective_modulus=e_star, **geometry)
    alone = {"thickness": thickness if model == "layered" else None}
    for k in range(6):
        one = contact.solve(
            model, **CASE | alone | {"force": push[k], "curvature": tuple(curvature[k])}
        )
        assert sorted([many.first[k], many.second[k]]) == pytest.approx(one.semi_axes[::-1])
        assert [many.peak[k], many.depth[k]] == pytest.approx([one.peak, one.depth])
        assert np.broadcast_to(many.exponent, 6)[k] == pytest.approx(one.exponent)
        at = rng.uniform(-3e-3, 3e-3, 2)  # the first curvature is the larger: its axis is the minor
        reading = many.reading(*at, 2e-3)[k]
        assert reading == pytest.approx(float(one.reading(at[::-1], 2e-3)), abs=1e-9 * one.peak)
    back = law.force(depth=many.depth, effective_modulus=e_star, **geometry)
    assert back == pytest.approx(push, rel=1e-8)


@pytest.mark.parametrize("model", contact.BATCHED)
def test_casadi_expressions_equal_numpy(model):
    law = contact.ContactModel(model, poisson=0.45, thickness=3e-3)
    d, k, e = ca.SX.sym("d"), ca.SX.sym("k", 2), ca.SX.sym("e")
    symbols = {"curvature": k, "indenter_radius": 0.01, "effective_modulus": e}
    y = law.force(depth=d, **symbols)
    patch = law.patches(force=y, **symbols)
    x = ca.vertcat(d, k, e)
    f = ca.Function("f", [d, k, e], [y, ca.vertcat(*patch), ca.jacobian(ca.vertcat(*patch), x)])
    value, patches, jacobian = f(2e-4, [12.0, 8.0], 0.6e6)
    numbers = symbols | {"curvature": np.array([12.0, 8.0]), "effective_modulus": 0.6e6}
    push = law.force(depth=2e-4, **numbers)
    plain = law.patches(force=push, **numbers)
    assert float(value) == pytest.approx(push)
    assert patches.full()[:, 0] == pytest.approx(np.array(plain, dtype=float))
    assert patches.full()[3, 0] == pytest.approx(2e-4)  # the depth comes back
    assert np.isfinite(jacobian.full()).all()


@pytest.mark.parametrize(
    ("model", "curvature", "thickness"),
    [("hertz", 10.0, None), ("elliptic", (200.0, 0.0), None), ("layered", (60.0, 0.0), 1e-3)],
)
def test_pressure_carries_the_force(model, curvature, thickness):
    patch = contact.solve(model, **CASE | {"curvature": curvature, "thickness": thickness})
    x, y = (((np.arange(400) + 0.5) / 200 - 1) * axis for axis in patch.semi_axes)
    grid = np.stack(np.meshgrid(x, y), axis=-1)
    cell = (x[1] - x[0]) * (y[1] - y[0])
    assert patch.pressure(grid).sum() * cell == pytest.approx(1.0, rel=1e-3)
    assert (patch.exponent > 0.6) == (model == "layered")


@pytest.mark.parametrize(
    ("model", "thickness"),
    [("hertz", None), ("elliptic", None), ("layered", 2e-3), ("field", None)],
)
def test_zero_force_gives_an_empty_patch(model, thickness):
    patch = contact.solve(model, **CASE | {"force": 0.0, "thickness": thickness})
    assert (patch.peak, patch.depth) == (0.0, 0.0)
    assert patch.pressure([[0.0, 0.0]]) == 0.0
    assert patch.reading([[0.0, 0.0]], 1e-3) == 0.0


def test_unknown_model_names_the_nearest():
    with pytest.raises(UnknownNameError, match="did you mean layered"):
        contact.ContactModel("layred")


@pytest.mark.parametrize("curvature", [100.0, 10.0, 0.0, -50.0, -90.0])
def test_parabolic_gap_at_its_limit_of_width(curvature):
    """At MAX_WIDTH circular arcs give 4 % smaller patches, whatever the curvature of the body."""
    tip, radius = 100.0, 1 / (100.0 + curvature)
    a = 0.519 / np.sqrt(tip**2 - tip * curvature + curvature**2)
    case = CASE | {"curvature": curvature, "modulus": 1e6, "poisson": 0.0}
    case["force"] = 4e6 / 3 * a**3 / radius
    patch, true = contact.solve("hertz", **case), contact.solve("field", **case)
    assert patch.semi_axes[0] / true.semi_axes[0] - 1 == pytest.approx(0.036, abs=0.006)
    assert patch.peak / true.peak - 1 == pytest.approx(-0.024, abs=0.004)
    with pytest.raises(ContactError, match="wide"):
        contact.solve("hertz", **case | {"force": 1.02 * case["force"]})


@pytest.mark.deep
@pytest.mark.parametrize("count", [30, pytest.param(150, marks=pytest.mark.slow)])
def test_any_arguments_give_a_patch_or_a_contact_error(count):
    rng = np.random.default_rng(5)
    solved = 0
    for _ in range(count):
        radius = 10 ** rng.uniform(-3, -1)
        thickness = None if rng.random() < 0.3 else 10 ** rng.uniform(-4.5, -1)
        try:
            patch = contact.solve(
                "hertz",
                force=10 ** rng.uniform(-4, 2.5),
                curvature=tuple(rng.uniform(-1.3, 3, 2) / radius),
                indenter_radius=radius,
                modulus=10 ** rng.uniform(3.5, 9),
                poisson=rng.uniform(-0.9, 0.5),
                thickness=thickness,
                upgrade=True,
            )
        except ContactError:
            continue
        solved += 1
        assert patch.semi_axes[0] >= patch.semi_axes[1] > 0
        assert 0 < patch.depth < np.inf
        assert 0 < patch.peak < np.inf
        assert patch.pressure([0.0, 0.0]) == pytest.approx(patch.peak, rel=1e-2)
        assert patch.reading([0.0, 0.0], patch.semi_axes[1] / 2) < patch.peak
    assert solved > count / 3


@pytest.mark.parametrize("model", contact.BATCHED)
def test_derivatives_by_the_position_of_the_indenter_on_a_sphere(model):
    """The force is smooth at an umbilic, where the two principal curvatures are equal."""
    body, centre = Body.sphere(0.1), np.array([0.0, 0.02, 0.107])
    hit = body.closest(centre[None])
    c, uv, x = ca.SX.sym("c", 21, 3), ca.SX.sym("uv", 2), ca.SX.sym("x", 3)
    _, _, foot, normal, curvature = casadi_foot(c, uv[0], uv[1], x)
    law = contact.ContactModel(model, poisson=0.49, thickness=3e-3)
    given = {"indenter_radius": 0.01, "effective_modulus": 0.26e6}
    y = law.force(depth=0.01 - ca.dot(x - foot, normal), curvature=curvature, **given)
    f = ca.Function("f", [c, uv, x], [y, ca.gradient(y, x), ca.hessian(y, x)[0]])
    value, gradient, hessian = f(body.surface.patches[hit.face[0]], hit.uv[0], centre)
    depth = 0.01 - (np.linalg.norm(centre) - 0.1)
    given["curvature"] = np.array([10.0, 10.0])
    assert float(value) == pytest.approx(law.force(depth=depth, **given), rel=1e-3)
    slope = [law.force(depth=depth + d, **given) for d in (1e-7, -1e-7)]
    push = -(slope[0] - slope[1]) / 2e-7 * centre / np.linalg.norm(centre)
    assert gradient.full()[:, 0] == pytest.approx(push, rel=1e-2, abs=1.0)
    assert np.isfinite(hessian.full()).all()


@pytest.mark.parametrize("poisson", [-0.2, 0.45])
@pytest.mark.parametrize("thickness", [None, 3e-3, 0.05])
@pytest.mark.parametrize("model", contact.BATCHED)
def test_is_valid_exactly_where_solve_succeeds_and_its_error_begins_with_the_limit(
    model, thickness, poisson
):
    rng = np.random.default_rng(2)
    curvature = rng.uniform(-120, 300, (300, 2)) * 10.0 ** rng.uniform(-3, 0, (300, 1))
    curvature[0] = np.nan
    curvature[1] = curvature[1, 0]
    for force, modulus in [(1.0, 0.5e6), (3.0, 0.05e6)]:
        soft = {"modulus": modulus, "poisson": poisson, "thickness": thickness}
        each = []
        for pair in curvature:
            try:
                contact.solve(
                    model, force=force, indenter_radius=0.01, curvature=tuple(pair), **soft
                )
            except ContactError as error:
                each.append(error.what)
            else:
                each.append("")
        law = contact.ContactModel(model, poisson, thickness)
        case = {"force": force, "curvature": curvature, "indenter_radius": 0.01}
        case["effective_modulus"] = modulus / (1 - poisson**2)
        assert law.exceeded_limits(**case).tolist() == each
        assert law.is_valid(**case).tolist() == [words == "" for words in each]


@pytest.mark.parametrize(("thickness", "name"), [(None, "elliptic"), (5e-4, "layered")])
def test_where_no_model_holds_the_most_general_one_says_why(thickness, name):
    """A patch of 1 N that is too wide for an indenter of 2 mm on soft skin."""
    indentation = Indentation(1.0, 2e-3, Material(young=0.2e6, thickness=thickness))
    curvature = np.array([[90.0, 20.0]])
    assert all(indentation.invalid_reasons(m, curvature)[0] for m in BATCHED)
    assert indentation.first_valid_model(curvature) == name
