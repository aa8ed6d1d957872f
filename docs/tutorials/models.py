# %% [markdown]
# # Which model predicts best?
#
# You want to know which model of the printer predicts best, and by how much. On this page you compare three
# models on scans on which none of the models was trained. You get confidence intervals, and see how much of
# each error is noise.

# %%
import litho_data
import litho_models

card = litho_data.simulate("campaign", count=8, size_px=128, seed=0)
built = litho_data.build_dataset(card, "prints.zarr")

# %% [markdown]
# `benchmark` divides the scans, except the locked scans, into folds. Each fold is predicted by models trained
# on the other folds. The error is the mean absolute difference between measured and predicted height after
# the unknown zero of each scan is removed ([why](../evaluation.md#two-errors)).

# %%
result = litho_models.benchmark("prints.zarr", "benchmark", models=("affine", "linear", "physics"), folds=2)
for scores in result.scores:
    low, high = scores.mae_datum_free_ci95_nm
    print(f"{scores.model:8} {scores.mae_datum_free_nm:6.2f} nm   95 % over scans {low:.2f} … {high:.2f}")

# %% [markdown]
# Two models may differ significantly even if the intervals of their errors overlap, because the test
# compares the models scan by scan.

# %%
for pair in result.paired:
    print(
        f"{pair.first} − {pair.second}: {pair.mean_nm:+.2f} nm, "
        f"{pair.first} better in {pair.first_better} of {pair.scans} scans, p = {pair.p:.2g}"
    )

# %% [markdown]
# Scans of one print are not independent. If there are several prints, `pair.over_prints` compares the models
# print by print. Part of every error is noise that no model can predict:

# %%
floor = result.noise_floor
print(f"noise: {floor.mae_at('offset'):.2f} nm ({floor.kind})")

# %% [markdown]
# Draw the errors as bars, with one colour per model. `benchmark/report.html` contains this picture and all other
# figures and tables.

# %%
from litho_models.evaluation.plots import error_bars

error_bars(result.scores, floor.mae_at("offset"), paper_line=False)

# %% [markdown]
# Train the model that you chose on all scans except the locked scans, and freeze it. The result is a folder
# with weights and a card, which you can use in designs or share.

# %%
litho_models.train("prints.zarr", "physics", "run")
litho_models.freeze("run", "printer")
print(litho_models.load_frozen("printer"))

# %% [markdown]
# Next: [what the model still lacks](../closing_the_loop.md), [what the scores mean](../evaluation.md), [a hologram
# through the printer](optics.md).
