"""Product of a large symmetric matrix in half precision and one column on CUDA, which reads only the upper half.

For one column, reading determines the time, so that half of the matrix takes half of the time.
"""

import numpy as np
import warp as wp

from ..runtime.device import forward_kernel

# Rows and columns of a tile, which one block of 256 threads takes: eight warps of 32 rows each.
TILE = 256


@wp.func_native(
    snippet="""
#if defined(__CUDA_ARCH__)
    __shared__ float across[8][256];
    const int warp = threadIdx.x >> 5, lane = threadIdx.x & 31;
    const int first = 256 * I + 32 * warp, column = 256 * J + 8 * lane, size = matrix.shape[0];
    const bool inside = first < size && column < size;
    float own[8], down[8], along[32];
    for (int k = 0; k < 8; ++k) {
        own[k] = inside ? x.data[column + k] : 0.0f;
        down[k] = 0.0f;
    }
    const uint4* from = reinterpret_cast<const uint4*>(matrix.data + (long long)first * size + column);
    const int stride = size / 8;
    #pragma unroll
    for (int r = 0; r < 32; ++r) {
        const uint4 packed = inside ? __ldcs(from + r * stride) : make_uint4(0, 0, 0, 0);
        const unsigned pair[4] = {packed.x, packed.y, packed.z, packed.w};
        const float other = inside ? x.data[first + r] : 0.0f;
        float total = 0.0f;
        #pragma unroll
        for (int k = 0; k < 8; ++k) {
            const unsigned short bits = (unsigned short)(k & 1 ? pair[k / 2] >> 16 : pair[k / 2] & 0xffff);
            float a;
            asm("cvt.f32.f16 %0, %1;" : "=f"(a) : "h"(bits));
            total += a * own[k];
            down[k] += a * other;
        }
        along[r] = total;
    }
    // The sums over lanes of 32 rows, by halves: lane l ends with that of row l.
    #pragma unroll
    for (int step = 0; step < 5; ++step) {
        const int half = 16 >> step;
        const bool upper = lane & half;
        #pragma unroll
        for (int r = 0; r < 16; ++r) {
            if (r >= half) continue;
            const float kept = upper ? along[r + half] : along[r], given = upper ? along[r] : along[r + half];
            along[r] = kept + __shfl_xor_sync(0xffffffffu, given, half);
        }
    }
    if (first + lane < size) atomicAdd(y.data + first + lane, along[0]);
    if (I == J) return;
    for (int k = 0; k < 8; ++k) across[warp][32 * k + lane] = down[k];
    __syncthreads();
    float total = 0.0f;
    for (int w = 0; w < 8; ++w) total += across[w][32 * (threadIdx.x & 7) + (threadIdx.x >> 3)];
    if (256 * J + threadIdx.x < size) atomicAdd(y.data + 256 * J + threadIdx.x, total);
#endif
"""
)
def _add_tile(
    I: int, J: int, matrix: wp.array2d(dtype=wp.float16), x: wp.array(dtype=wp.float32), y: wp.array(dtype=wp.float32)
): ...


@forward_kernel(module="unique")
def _add_product(
    tiles: wp.array(dtype=wp.vec2i),
    matrix: wp.array2d(dtype=wp.float16),
    x: wp.array(dtype=wp.float32),
    # outputs
    y: wp.array(dtype=wp.float32),
):
    """Add A x to y. A tile adds its product to its rows; a tile above the diagonal also adds its transposed product."""
    tile = tiles[wp.tid() // TILE]
    _add_tile(tile[0], tile[1], matrix, x, y)


def list_tiles(size: int, device: str) -> wp.array:
    """Return the tiles (n,) on and above the diagonal of a matrix with `size` rows."""
    above = np.stack(np.triu_indices(-(-size // TILE)), axis=1).astype(np.int32)
    return wp.array(above, dtype=wp.vec2i, device=device)


def add_product(tiles: wp.array, matrix: wp.array, x: wp.array, y: wp.array) -> None:
    """Add A x (n,) to y (n,), in single precision; A (n, n) is symmetric, in half precision, with n % 64 = 0."""
    dim, device = len(tiles) * TILE, matrix.device
    wp.launch(_add_product, dim, [tiles, matrix, x], [y], device=device, block_dim=TILE, record_tape=False)
