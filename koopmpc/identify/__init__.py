"""From episodes to predictors: moments, DMD, DMDc, EDMD."""
