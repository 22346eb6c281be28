"""A folder of simulated measurements of two materials, and the stack files that made them."""

from pathlib import Path

import layerjax as lj
from fits import Measurements, simulate, slices, write_csv

BASE = """
[base]
kind = "Lambertian"
albedo = { start = 0.5, low = 0.0, high = 1.0 }
"""
COAT = """
[[layers]]
kind = "Medium"
thickness = { start = 1.0, low = 0.05, high = 5.0 }
albedo = 0.8
"""
HAZY = f'transport = "SingleScattering"\n{COAT}{BASE}'
NOISE = "\n[noise]\ndiscrepancy = false\n"
STACKS = {"coat": f"{HAZY}{NOISE}", "bare": f'transport = "SingleScattering"\n{BASE}{NOISE}'}
THICKNESS, COATED, BARE = 0.6, 0.4, 0.7
TRUE = {"coated.csv": {"layers[0].thickness": THICKNESS, "base.albedo": COATED}, "paint.csv": {"base.albedo": BARE}}
MATERIALS = {
    "coated": lj.Stack([lj.Medium(thickness=THICKNESS, albedo=0.8)], base=lj.Lambertian(COATED)),
    "paint": lj.Stack([], base=lj.Lambertian(BARE)),
}


def measurements(name: str) -> Measurements:
    """Simulated slices of a material, with noise."""
    view = slices(incidence=(10, 50), azimuth=(0, 60))
    return simulate(MATERIALS[name], view, transport=lj.SingleScattering(), noise=0.03, seed=1)


def make_folder(folder: Path) -> None:
    """coat.toml and bare.toml, and in scans/: coated.csv, paint.csv, one that is broken, and one that is no data."""
    scans = folder / "scans"
    scans.mkdir()
    for name in MATERIALS:
        write_csv(measurements(name), scans / f"{name}.csv")
    (scans / "broken.csv").write_text("theta_i,phi_i,theta_o,phi_o,brdf\n10,180,twenty,0,0.1\n")
    (scans / "README.md").write_text("Measurements of two samples.\n")
    for name, text in STACKS.items():
        (folder / f"{name}.toml").write_text(text)
