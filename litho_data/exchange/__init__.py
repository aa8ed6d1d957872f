"""Move data into and out of a store: releases, and the authors' pair format."""
