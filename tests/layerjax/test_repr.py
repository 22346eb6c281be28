"""Materials shown in words make the same material again; pictures of them are well-formed, whatever stands in them."""

import xml.etree.ElementTree as ET
from html import unescape

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import fits
import layerjax as lj

FREE = fits.Free(0.2, 0.1, 0.3)
COAT = lj.Stack(
    [
        lj.Interface(1.5, 0.3),
        lj.Medium(1, [0.9, 0.5, 0.2], lj.SGGX("fiber", 0.2, (1, 0, 0)), f0=0.04),
        lj.TurbidMedium(0.1, 20.0, phase=lj.Rayleigh()),
    ],
    lj.Conductor(0.2, 3.9, 0.1, "vmf"),
)
MAP = lj.Stack(
    [lj.Medium(jnp.full((4, 5, 1), 0.5), [0.3, 0.6, 0.7])],
    lj.Conductor(0.2, 3.9, alpha=jnp.linspace(0.1, 0.5, 20).reshape(4, 5)),
)
MIXTURE = lj.Mixture({"bare": lj.Stack([], lj.Lambertian([0.3, 0.2, 0.1])), "coated": COAT}, [0.3, None])

NAMES = {**vars(lj), **{name: getattr(fits, name) for name in fits.__all__}}

AGAIN = {
    "Interface(ior=1.5, alpha=0.3)": lj.Interface(1.5, 0.3),
    "Interface(ior=1.3, alpha=2.0, distribution='vmf')": lj.Interface(1.3, 2, "vmf"),
    "Medium(thickness=1.0)": lj.Medium(1.0),
    "Medium(thickness=1.0, albedo=0.0)": lj.Medium(1, 0),
    "Medium(thickness=[1.0, 2.0], f0=0.04)": lj.Medium([1.0, 2.0], f0=0.04),
    "Medium(thickness=1.0, phase=HenyeyGreenstein(g=0.7))": lj.Medium(1, phase=lj.HenyeyGreenstein(0.7)),
    "SGGX(kind='fiber', alpha=0.0001, axis=[1.0, 0.0, 0.0])": lj.SGGX("fiber", 1e-4, (1, 0, 0)),
    "Rayleigh()": lj.Rayleigh(),
    "ThinFilm(ior=1.5, thickness_nm=100.0, wavelengths_nm=[610.0, 550.0])": lj.ThinFilm(1.5, 100, [610, 550]),
    "OrenNayar(albedo=0.5, roughness=0.3)": lj.OrenNayar(0.5, 0.3),
    "Stack(layers=[], base=Lambertian(albedo=[0.5]))": lj.Stack([], lj.Lambertian([0.5])),
    "Stack(layers=[Interface(ior=1.5, alpha=Free(0.2, 0.1, 0.3))])": lj.Stack([lj.Interface(1.5, FREE)]),
    "Free((0.5, 0.6), 0.1, 0.9, LogUniform(), random_walk_sd=0.1)": fits.Free(
        (0.5, 0.6), 0.1, 0.9, fits.LogUniform(), random_walk_sd=0.1
    ),
    "PowerLaw(amplitude=Free(0.2, 0.1, 0.3), exponent=1.2, wavelengths=[450.0, 650.0], reference=550.0)": (
        fits.PowerLaw(FREE, 1.2, (450, 650), 550)
    ),
}


@pytest.mark.parametrize("words", AGAIN)
def test_words_are_the_call_with_the_numbers_that_were_typed(words):
    assert repr(AGAIN[words]) == words
    assert made_again(words) == words


@pytest.mark.parametrize("material", [COAT, MIXTURE], ids=["stack", "mixture"])
def test_words_make_the_same_material(material):
    assert eqx.tree_equal(eval(repr(material), NAMES), material)


def test_numbers_have_the_digits_of_their_own_precision():
    assert repr(lj.Lambertian(jnp.float32(0.1))) == "Lambertian(albedo=0.1)"
    third = lj.Lambertian(1 / 3)
    assert repr(third) == "Lambertian(albedo=0.3333333333333333)"
    assert eval(repr(third), vars(lj)).albedo == third.albedo


def test_of_maps_shape_and_range_are_shown():
    assert repr(MAP) == (
        "Stack(layers=[Medium(thickness=<4 x 5 x 1 of 0.5>, albedo=[0.3, 0.6, 0.7])], "
        "base=Conductor(ior=0.2, k=3.9, alpha=<4 x 5 from 0.1 to 0.5>))"
    )
    assert repr(lj.Lambertian(np.linspace(0.1, 0.9, 31))) == "Lambertian(albedo=<31 from 0.1 to 0.9>)"


def test_of_what_is_traced_type_and_shape_are_shown():
    seen = []

    def look(stack, number):
        medium = lj.Medium(1.0)
        seen.extend([repr(stack), repr(lj.Interface(1.5, number)), repr(outside), repr(medium), stack._repr_html_()])
        return number

    outside = lj.Medium(2.0)  # its default phase function, made outside of the program, is known there
    jax.jit(look)(MAP, 0.1)
    jax.vmap(look, (None, 0))(MAP, jnp.ones(3) * 0.1)
    assert seen[0] == (
        "Stack(layers=[Medium(thickness=f64[4,5,1], albedo=f64[3], phase=HenyeyGreenstein(g=f64[]))], "
        "base=Conductor(ior=f64[], k=f64[], alpha=f64[4,5]))"
    )
    assert seen[1] == seen[6] == "Interface(ior=1.5, alpha=f64[])"  # what is written into a program is known
    assert seen[2] == seen[7] == "Medium(thickness=2.0)"
    assert "ior f64[], k f64[], alpha f64[4,5]" in words_of(seen[4])


def test_showing_adds_nothing_to_a_program():
    def plain(stack):
        return stack.layers[0].ior

    def shown(stack):
        repr(stack)
        return plain(stack)

    assert str(jax.make_jaxpr(shown)(COAT)) == str(jax.make_jaxpr(plain)(COAT))


@pytest.mark.parametrize(
    "fill",
    [
        None,
        True,
        "two\nlines",
        object(),
        jax.ShapeDtypeStruct((3,), float),
        np.zeros((0, 3)),
        lambda x: x,
        float("nan"),
    ],
    ids=lambda fill: type(fill).__name__,
)
@pytest.mark.parametrize("material", [COAT, MIXTURE, MAP], ids=["stack", "mixture", "map"])
def test_whatever_stands_in_a_material_it_is_shown_on_one_line(material, fill):
    filled = jax.tree.map(lambda _: fill, material)
    assert "\n" not in repr(filled)
    assert ET.fromstring(f"<p>{filled._repr_html_()}</p>") is not None


def test_an_array_that_is_gone_is_shown_by_its_shape():
    gone = jnp.full(3, 0.5)
    surface = lj.Lambertian(gone)
    surface.albedo.delete()
    assert repr(surface) == "Lambertian(albedo=f64[3])"


def test_errors_show_a_stack_on_one_line():
    with pytest.raises(ValueError, match="is not an Interface") as error:
        lj.Stack([COAT])
    assert "\n" not in str(error.value)


def test_picture_names_layers_and_numbers_from_top_to_bottom():
    words = words_of(COAT._repr_html_())
    assert words == [
        *("Interface", "ior 1.5, alpha 0.3"),
        *("Medium", "thickness 1, albedo [0.9, 0.5, 0.2], phase SGGX (fiber, alpha 0.2,", "axis [1, 0, 0]), f0 0.04"),
        *("TurbidMedium", "thickness_mm 0.1, mu_s 20, phase Rayleigh"),
        *("Conductor", "ior 0.2, k 3.9, alpha 0.1, vmf"),
    ]


def test_picture_of_a_mixture_has_its_shares():
    shown = MIXTURE._repr_html_()
    assert "<strong>bare: 0.3 of the area</strong>" in shown
    assert "<strong>coated: the rest of the area</strong>" in shown
    assert shown.count("<svg") == 2


def test_picture_of_a_stack_without_base_says_that_light_passes():
    assert words_of(lj.Stack([lj.Interface(1.5, 0.1)])._repr_html_())[-1] == "no base: light passes"
    assert words_of(lj.Stack([])._repr_html_()) == ["no base: light passes"]


class Script(lj.Rayleigh):
    """A phase function of one's own, with words that HTML would take for its own."""

    note: str = eqx.field(static=True, default="")


def test_pictures_escape_every_word():
    shown = lj.Stack([lj.Medium(1.0, phase=Script(note="<script>alert(1)</script> & 'more'"))])._repr_html_()
    assert "<script" not in shown
    assert any("<script>" in line for line in words_of(shown))
    assert "&amp;" in shown
    assert "'more'" in unescape(shown)


def test_pictures_take_the_colours_of_the_page_and_run_nothing():
    shown = COAT._repr_html_()
    assert 'fill="currentColor"' in shown
    for word in ("<script", "<style", "id=", "class=", "href", "onload", "#"):
        assert word not in shown
    assert len(shown) < 8000


def made_again(words):
    return repr(eval(words, NAMES))


def words_of(html):
    """Lines of text in a picture, from top to bottom."""
    return [
        element.text
        for element in ET.fromstring(html).iter("{http://www.w3.org/2000/svg}text")
        if element.text is not None
    ]
