"""Episodes on disk: tables, .csv, .parquet, .npz, folders."""
