"""What is wrong with logs before a model is fitted to them: one kind of evidence a file, `report` asks them all."""
