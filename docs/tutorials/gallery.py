# %% [markdown]
# # Twelve pictures, ten lines each
#
# Each picture is drawn by the code above it. Run all the code once, from top to bottom. The first cell simulates
# four prints and defines a function that shows maps. All maps are about 16 µm wide. For real prints, see
# [your own scans](../own_data.md).

# %%
import litho_data
from litho_data.reports.pictures import new_figure


def show(pictures, colours="viridis", **limits):
    figure = new_figure(2.6 * len(pictures), 2.6)
    for axes, (title, picture) in zip(figure.subplots(1, len(pictures)), pictures.items(), strict=True):
        drawn = axes.imshow(picture, cmap=colours, **limits)
        figure.colorbar(drawn, ax=axes, shrink=0.7)
        axes.set_title(title, fontsize=9)
        axes.set_axis_off()
    return figure


card = litho_data.simulate("campaign", count=4, size_px=160, seed=3)
_ = litho_data.build_dataset(card, "prints.zarr")

# %% [markdown]
# ## 1. What to print: [layouts](../layouts.md), in levels of 0.1 µm

# %%
from litho_data.layouts import isolated_features, random_layout, siemens_star, step_ladder

layouts = {
    "random": random_layout((160, 160), seed=1),
    "stair": step_ladder((160, 160), highest=12),
    "star": siemens_star((160, 160), spokes=18, high=12),
    "pillars": isolated_features((160, 160), widths_px=[1, 2, 3, 5, 8, 12], feature=12, ground=0),
}
show(layouts)

# %% [markdown]
# ## 2. What a microscope gives back: [a raw scan](../readers.md), then [levelled](../levelling.md)

# %%
scan = litho_data.read_scan(card.parent / "scans" / "P1F1.txt", size_um=(16.8, 16.8), unit="m")
recipe = litho_data.Recipe.from_dict({"step": [{"op": "polynomial", "total_degree": 2}]})
levelled, removed = litho_data.level_scan(scan, recipe)
show({"raw, µm": scan.height_um, "removed, µm": removed, "levelled, µm": levelled.height_um})

# %% [markdown]
# ## 3. The scan on its layout: [registration](../registration.md)

# %%
store = litho_data.open_store("prints.zarr")
first = store.scan("P1F1")
nominal_um = first.mask_level * first.level_height_um
show(
    {
        "layout, µm": nominal_um,
        "print, µm": first.height_um,
        "print − layout, µm": first.height_um - nominal_um,
    }
)

# %% [markdown]
# ## 4. How certain each height is: [standard uncertainty](../noise.md)

# %%
import numpy as np

slope = np.hypot(*np.gradient(first.height_um, first.pitch_um))
show({"slope": slope, "σ of the height, nm": 1e3 * first.height_sigma_um})

# %% [markdown]
# ## 5. How rough it is: [spectra along and across the lines](../roughness.md)

# %%
from litho_data.roughness import psd_along

figure = new_figure(9.6, 3.4)
axes = figure.subplots()
for axis in ("x", "y"):
    spectrum = psd_along(levelled.height_um, scan.pitch_um[0], axis)
    axes.loglog(spectrum.frequency_per_um, spectrum.density, label=f"along {axis}")
axes.set_xlabel("cycles per µm")
axes.set_ylabel("density, nm² µm")
_ = axes.legend()
figure

# %% [markdown]
# ## 6. What a blunt tip hides: [the tip](../roughness.md)

# %%
from litho_data.tip import tip_certain

touched = tip_certain(levelled.height_um, scan.pitch_um, 0.3)
show({"scan, µm": levelled.height_um, "touched by a tip of 0.3 µm": touched})

# %% [markdown]
# ## 7. One layout through four models: [the zoo](../models.md), heights in µm

# %%
import torch

import litho_models

layout_um = torch.tensor(nominal_um, dtype=torch.float32)[None, None]
names = ("identity", "affine-mtf", "physics", "pbl")
models = {name: litho_models.load_frozen(f"zoo:{name}") for name in names}
prints = {name: model(layout_um)[0, 0].numpy() for name, model in models.items()}
show(prints, vmin=0, vmax=1.2)

# %% [markdown]
# ## 8. What a model misses: [residuals](../evaluation.md) of models trained on another printer, in nm

# %%
missed = {name: first.height_um - own for name, own in prints.items()}
show({name: 1e3 * (one - np.nanmedian(one)) for name, one in missed.items()}, "RdBu_r", vmin=-150, vmax=150)

# %% [markdown]
# ## 9. What could be the cause: changes by two [knobs of the virtual fab](../virtual_fab.md), in nm

# %%
from litho_data.virtual_fab import Fab, Job, KnobSetting, Microscope, Noise, Printer, scan_job
from litho_data.virtual_fab.knobs import KnobBoard

strengths = {"none": [], "vignetting": [("vignetting", 0.3)], "galvo-lag": [("galvo-lag", 0.4)]}
scans = {}
for name, knobs in strengths.items():
    board = KnobBoard([KnobSetting(*knob, 0) for knob in knobs], 0)
    fab = Fab(Printer(), Microscope.aligned(), Noise.off(), board, 0)
    scans[name] = scan_job(fab, Job("P1F1", first.mask_level)).clean_um
changes = {name: 1e3 * (one - scans["none"]) for name, one in scans.items() if name != "none"}
show(changes, "RdBu_r", vmin=-150, vmax=150)

# %% [markdown]
# ## 10. A hologram [through the printer](../optics.md): its layout, its print, its image

# %%
import litho_design

small = {"layout.size_px": 160, "optics.distance_um": 15, "search.iterations": 20, "search.polish_rounds": 0}
settings = litho_design.hologram_settings(changes=small)
litho_design.design_hologram("text", "zoo:physics", "hologram", settings=settings, judges=())
design = litho_design.load_design("hologram")
printed_um = design.printed_um(litho_design.load_printer("zoo:physics", settings.layout))
show({"levels": design.level, "print, µm": printed_um, "image": design.display(design.image(printed_um))})

# %% [markdown]
# ## 11. A lens [in a program of your own](../element.md): its focus at 20 µm, from the wave behind its print

# %%
element = litho_design.Element("zoo:physics", {"size_px": 160, "cell_um": 0.1})
x_um = (torch.arange(160) - 79.5) * 0.1
wave = torch.polar(torch.ones(160, 160), torch.pi * (x_um**2 + x_um[:, None] ** 2) / 0.6328 / 20)
element.start_from_phase(-wave.angle(), 0.6328)
behind = element(torch.ones_like(wave), wavelength_um=0.6328).detach()
focus = torch.fft.fftshift(torch.fft.fft2(behind * wave)).abs() ** 2
pictures = {"levels": element.levels(), "phase, rad": behind.angle()}
show(pictures | {"focus, logarithm": torch.log10(focus + 1e-5 * focus.max())})

# %% [markdown]
# ## 12. What the printer gets: [files](../export.md), read back

# %%
from matplotlib.image import imread

file = litho_design.export("hologram", "png16", "files")
levels, sidecar = litho_design.import_levels(file)
show({f"{file.name}: grey": imread(file), "levels read back": levels})
