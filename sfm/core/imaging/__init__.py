"""Operations on images: arrays (H, W) or (H, W, 3) RGB, `image[y, x]`, uint8 at the edge and float32 inside.

Functions here know nothing of cameras. Pixel coordinates have the centre of the first pixel at (½, ½), as
everywhere; `resample` converts them for OpenCV, which has it at (0, 0).
"""
