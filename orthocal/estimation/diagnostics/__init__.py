"""Of a fit: single readings, prediction of the unseen, intervals, what is not modelled."""
