"""Our own kernels for MuJoCo Warp's worlds. Imported at the first use only: it needs the extra ``gpu``."""

import warp as wp  # pyright: ignore[reportMissingImports]


@wp.kernel
def put_targets(
    targets_SNA: wp.array3d[float],
    number: int,
    columns_A: wp.array[int],
    controls: wp.array2d[float],
):
    """Write the targets of one of S sub-commands into the controls of N worlds."""
    world, k = wp.tid()
    controls[world, columns_A[k]] = targets_SNA[number, world, k]
