"""On/off and stepped inputs: their levels and dwell times, and the search for the best plan on them."""
