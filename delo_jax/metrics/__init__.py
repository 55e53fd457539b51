"""How good poses are: registration errors, KITTI drift, absolute trajectory error. Float64 NumPy arrays in and out."""
