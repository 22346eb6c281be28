"""What a scene does not hold leaves no operations behind: counted in the lowered program."""

import jax
import jax.numpy as jnp
import pytest

import layerjax as lj
from benchmarks.measuring.operations import count, total

SINGLE = lj.SingleScattering()

WI, WO = lj.direction(jnp.linspace(0.1, 1.4, 50), 0.0), lj.direction(jnp.linspace(0.2, 1.3, 50), 2.0)
BASE = lj.Lambertian(0.5)
FLAKES = lj.SGGX("surface", 0.3)


def program(stack, side="all"):
    return count(lambda wi, wo: lj.evaluate(stack, wi, wo, SINGLE, side=side), WI, WO)


def operations(stack, side="all"):
    return sum(program(stack, side).values())


def medium(**changes):
    return lj.Medium(**{"thickness": 0.7, "albedo": 0.9, "phase": FLAKES, **changes})


def test_the_count_sees_work():
    assert total(lambda x: jnp.exp(x) + x, jnp.ones(3)) == 2
    assert operations(lj.Stack([medium()])) > 20


def test_absent_layers():
    assert program(lj.Stack([medium(thickness=0.0)], BASE)) == program(lj.Stack([], BASE))
    one, two = operations(lj.Stack([medium()], BASE)), operations(lj.Stack([medium(), medium()], BASE))
    assert one < two


def test_a_bare_base_pays_for_no_media():
    bare = program(lj.Stack([], BASE))
    assert bare["exponential"] == bare["sqrt"] == bare["subtract"] == 0
    assert sum(bare.values()) < 12


def test_a_missing_base():
    without, with_base = (program(lj.Stack([medium()], base), "reflection") for base in (None, BASE))
    assert sum(without.values()) < sum(with_base.values())


def test_reflection_only():
    stack = lj.Stack([medium(), medium()])
    everything, reflection = program(stack, "all"), program(stack, "reflection")
    assert reflection["exponential"] * 2 == everything["exponential"]
    assert reflection["abs"] == 0 < everything["abs"]
    assert sum(reflection.values()) < sum(everything.values())
    assert operations(stack, "transmission") < sum(everything.values())


def test_an_opaque_base_asks_for_no_lower_side():
    stack = lj.Stack([medium()], BASE)
    assert program(stack, "all") == program(stack, "reflection")


def test_one_channel():
    one = operations(lj.Stack([medium()], BASE), "reflection")
    three = operations(lj.Stack([medium(albedo=[0.9, 0.8, 0.7])], lj.Lambertian([0.1, 0.2, 0.3])), "reflection")
    assert one < three < one + 20  # colour costs a few products a channel, no exponential


def test_colour_shares_the_exponentials():
    grey = program(lj.Stack([medium()]), "reflection")
    colour = program(lj.Stack([medium(albedo=[0.9, 0.8, 0.7])]), "reflection")
    tinted = program(lj.Stack([medium(thickness=[0.5, 1.0, 2.0])]), "reflection")
    assert grey["exponential"] == colour["exponential"] < tinted["exponential"]


@pytest.mark.parametrize("absent", [None, 1.0])
def test_no_fresnel_term(absent):
    assert program(lj.Stack([medium(f0=absent)])) == program(lj.Stack([medium()]))
    zero, some = operations(lj.Stack([medium(f0=0.0)])), operations(lj.Stack([medium(f0=0.04)]))
    assert operations(lj.Stack([medium()])) < zero < some


def test_haze_alone_needs_no_half_vector():
    haze = medium(phase=lj.HenyeyGreenstein(0.5))
    plain, fresnel = (program(lj.Stack([layer]), "reflection") for layer in (haze, medium(phase=haze.phase, f0=0.04)))
    flakes = program(lj.Stack([medium()]), "reflection")
    assert plain["sqrt"] == 1 < fresnel["sqrt"]  # that of the phase function itself
    assert sum(plain.values()) < sum(flakes.values())


def test_an_upright_axis():
    upright = operations(lj.Stack([medium()]))
    tilted = operations(lj.Stack([medium(phase=lj.SGGX("surface", 0.3, (0.3, 0.0, 1.0)))]))
    assert upright < tilted - 20


def test_an_absorbing_medium_has_no_lobe():
    dark = program(lj.Stack([medium(albedo=0.0)], BASE))
    grey = program(lj.Stack([medium()], BASE))
    assert sum(dark.values()) < sum(grey.values()) - 20
    assert operations(lj.Stack([medium(albedo=0.0)])) < 10


def test_traced_values_are_kept():
    # a derivative with respect to a thickness of 0 is not 0: what is traced must not be simplified away
    def value(thickness):
        return lj.evaluate(lj.Stack([medium(thickness=thickness)]), WI[0], WO[0], SINGLE)[0]

    assert value(0.0) == 0.0
    assert jax.grad(value)(0.0) > 0.0


def test_an_axis_that_is_the_normal_costs_nothing():
    upright = program(lj.Stack([medium(phase=lj.SGGX("surface", 0.3, (0.0, 0.0, 2.0)))]))
    assert upright == program(lj.Stack([medium()]))
