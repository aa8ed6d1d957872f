# %% [markdown]
# # From scans to a dataset
#
# You have AFM scans of some prints, and the layouts of these prints. By the end of this page, you have one
# dataset. In it, every scan is aligned to its layout pixel by pixel, and the origin of every number is
# recorded. Here the scans come from the built-in virtual fab. For [your own scans](../own_data.md), only the
# first step differs.

# %%
import litho_data

card = litho_data.simulate("campaign", count=6, size_px=160, seed=3)
print(card)

# %% [markdown]
# `card.toml` states which files are scans and which layout belongs to each scan. It also states the pitch, the
# level height and the units, because the files do not. The scans are raw: tilted, bowed, slightly rotated, and
# with an unknown zero. Read one scan:

# %%
scan = litho_data.read_scan(card.parent / "scans" / "P1F1.txt", size_um=(16.8, 16.8), unit="m")
low, high = scan.height_um.min(), scan.height_um.max()
print(f"{scan.name}: {scan.height_um.shape} pixels, heights {low:.2f} … {high:.2f} µm")

# %% [markdown]
# One call reads all scans, registers each scan to its layout and stores the result with its history. If the card
# names a levelling recipe, the recipe is applied too.

# %%
result = litho_data.build_dataset(card, "prints.zarr")
print(result.n_scans, "scans stored,", len(result.skipped), "skipped")

# %% [markdown]
# The quality table shows how well each scan fits its layout. `ncc_after` is the correlation of height and
# layout after registration. `tre_median_nm` is the median distance between details of the scan and the same
# details of the layout, in blocks that the fit did not use ([good values](../registration.md)).

# %%
store = litho_data.open_store("prints.zarr")
columns = ["scan", "ncc_before", "ncc_after", "tre_median_nm", "rotation_deg"]
print(store.quality[columns].round(3).to_string(index=False))

# %% [markdown]
# Look at one scan beside its layout. Both are in µm on the same grid; pixels that were not measured are NaN.

# %%

import numpy as np

from litho_data.reports.pictures import new_figure

printed = store.scan(store.ids[0])
figure = new_figure(9, 3.2)
off_um = printed.height_um - printed.layout_um
most_um = np.nanmax(np.abs(off_um))
panels = {
    "layout, µm": (printed.layout_um, {}),
    "measured height, µm": (printed.height_um, {}),
    "measured − layout, µm": (off_um, {"cmap": "RdBu_r", "vmin": -most_um, "vmax": most_um}),
}
for axes, (title, (image, scale)) in zip(figure.subplots(1, 3), panels.items(), strict=True):
    shown = axes.imshow(image, **scale)
    axes.set_title(title, fontsize=10)
    axes.set_axis_off()
    figure.colorbar(shown, ax=axes, shrink=0.8)
figure

# %% [markdown]
# The print is flatter and rounder than its layout. A model of the printer has to learn this difference.
# Before you share the dataset, check that nothing has changed since it was built:

# %%
checked = litho_data.verify("prints.zarr")
print(
    f"{checked.n_arrays} arrays and {checked.n_raw_files} raw files hashed again, {len(checked.findings)} changed"
)

# %% [markdown]
# `xarray.open_zarr` opens `prints.zarr` without this package. Next: [which model predicts these prints
# best](models.md), [how levelling works](../levelling.md), [what is in the file](../dataset_store.md).
