"""Truth of published image sets as `Reconstruction`s, for development and benchmarks; not installed."""

from datasets.benchmarks.readers import read_bundler, read_imc, read_kitti, read_middlebury, read_strecha

READERS = {
    "strecha": read_strecha,
    "middlebury": read_middlebury,
    "imc": read_imc,
    "kitti": read_kitti,
    "bundler": read_bundler,
}

__all__ = ["READERS", "read_bundler", "read_imc", "read_kitti", "read_middlebury", "read_strecha"]
