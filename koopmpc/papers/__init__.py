"""Papers whose published results `koopmpc reproduce` computes again."""
