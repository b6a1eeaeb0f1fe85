"""The only readers and writers: images, the database, models, calibration files and point clouds.

Modules are imported one by one (`from sfm.io.images import read_image`), so that a command loads only what it needs.
"""
