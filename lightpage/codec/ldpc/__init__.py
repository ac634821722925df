"""The low-density parity-check codes of 5G New Radio, base graph 1 (3GPP TS 38.212, section 5.3.2)."""
