"""Other methods behind two protocols: pairs of scans, and whole drives; `registry.METHODS` lists them."""
