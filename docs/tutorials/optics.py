# %% [markdown]
# # A hologram through the printer
#
# You want a printed element to show an image. On this page you design such an element with a model of the printer,
# judge it with another model, and write the file for the printer. The models come with the package.

# %%
import litho_design

settings = litho_design.hologram_settings(
    changes={"layout.size_px": 192, "optics.distance_um": 18, "search.iterations": 30}
)
designs = {
    name: litho_design.design_hologram("text", model, name, settings=settings)
    for name, model in {"without": "none", "with": "zoo:physics"}.items()
}

# %% [markdown]
# `without` was designed for a perfect printer. For `with`, a model trained on measured prints was used. A good
# score proves nothing if it comes from the design's own model. So another model, used for neither design,
# predicts both prints, and their images are scored:

# %%
judged = {
    name: litho_design.score(name, f"score-{name}", judges=["zoo:pbl"]).scores[0].figures for name in designs
}
for name, figures in judged.items():
    print(f"{name:8} {figures['si_psnr_db']:.1f} dB, SSIM {figures['ssim']:.3f}")

# %% [markdown]
# Show both images as the independent model predicts them:

# %%
from litho_data.reports.pictures import new_figure

printer = litho_design.load_printer("zoo:pbl", settings.layout)
loaded = {name: litho_design.load_design(name) for name in designs}
images = {"wanted": loaded["with"].target.numpy()}
for name, design in loaded.items():
    title = f"designed {name} the model: {judged[name]['si_psnr_db']:.1f} dB"
    images[title] = design.display(design.image(design.printed_um(printer)))
figure = new_figure(9.6, 3.5)
for axes, (title, image) in zip(figure.subplots(1, 3), images.items(), strict=True):
    axes.imshow(image, cmap="inferno", vmin=0, vmax=1.5)
    axes.set_title(title, fontsize=10)
    axes.set_axis_off()
figure

# %% [markdown]
# Both images are predictions. Only a measurement proves a design, so `litho_design.score` also accepts a
# photograph of the image or an AFM scan of the print. To print the element, export the layout as an image of
# levels. A second file, the sidecar, states heights and size, so that the image can be read back.

# %%
print(litho_design.export("with", "png16", "to-printer").name)

# %% [markdown]
# Next: [lenses, process windows](../optics.md), [what the scores mean](../scores.md), [comparing models as
# designers](../gap.md).
