"""The records as a web site of plain files, which needs no server: pages, figures, and rollouts to look at."""
