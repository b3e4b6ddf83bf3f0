// Front-to-back compositing of one tile of 16x16 pixels, forward and backward. A vector holds a block of 4x4 pixels:
// blocks that a footprint misses, or whose rays have all ended, are left out before anything is computed for them.
#pragma once
#include "project.h"

constexpr int BLOCK = 4, TILE = 16, BLOCKS = 16;  // pixels a side, pixels a side, blocks of a tile
static_assert(BLOCK * BLOCK == LANES && BLOCKS == LANES, "one vector is one block's pixels, or a value for each block");

// A footprint and a tile that it reaches.
struct Pair {
  uint32_t footprint_index, slot;  // the latter: where the pair's gradient goes
};

// Coordinates of lane i: as a pixel of a block, relative to the block's centre; as a block of a tile, of the block's centre.
INLINE Lanes lane_x(float origin, float step) {
  Lanes r;
  for (int i = 0; i < LANES; i++) r[i] = origin + step * (i % 4 - 1.5f);
  return r;
}
INLINE Lanes lane_y(float origin, float step) {
  Lanes r;
  for (int i = 0; i < LANES; i++) r[i] = origin + step * (i / 4 - 1.5f);
  return r;
}

// Pixels of a tile: block centres, and pixels relative to their block's centre.
struct Grid {
  Lanes block_x, block_y, x, y;
  Grid(int X, int Y)
      : block_x(lane_x(X + 8, 4)), block_y(lane_y(Y + 8, 4)), x(lane_x(0, 1)), y(lane_y(0, 1)) {}
};

// One footprint over a tile: alpha = 2^(log2_opacity - a s^2 - m dy^2) with s = dx + k dy. A sum of squares does not cancel,
// however long and thin the footprint.
struct Layer {
  Lanes s0, dy0, s;  // s and dy at each block's centre; by pixel: s from there
  float a, m, log2_opacity, red, green, blue, z;

  INLINE_MEMBER void set(const Footprint& g, const Grid& grid, const Lanes& dx, const Lanes& dy) {
    s0 = dx + g.k * dy, dy0 = dy, s = grid.x + g.k * grid.y;
    a = g.a, m = g.m, log2_opacity = g.log2_opacity, red = g.red, green = g.green, blue = g.blue, z = g.z;
  }
  INLINE_MEMBER Lanes s_at(int b) const { return s + s0[b]; }
  INLINE_MEMBER Lanes dy_at(int b, const Grid& grid) const { return grid.y + dy0[b]; }
  INLINE_MEMBER Lanes alpha(int b, const Grid& grid) const {
    const Lanes s = s_at(b), dy = dy_at(b, grid);
    return exp2(log2_opacity - a * s * s - m * dy * dy);
  }
};

// Blocks with a pixel centre at which the footprint may reach ALPHA_MIN: the least of the quadratic form over a rectangle
// lies on one of the two edges that face the centre.
INLINE uint32_t touched_blocks(const Footprint& g, const Lanes& dx, const Lanes& dy) {
  const float reach = .5f * (BLOCK - 1);
  Lanes left = dx - reach, right = dx + reach, top = dy - reach, bottom = dy + reach;
  Lanes x1 = clamp(Lanes{}, left, right), y1 = clamp(x1 * g.dy_per_dx, top, bottom);
  Lanes y2 = clamp(Lanes{}, top, bottom), x2 = clamp(y2 * -g.k, left, right);
  Lanes s1 = x1 + g.k * y1, s2 = x2 + g.k * y2;
  const float ratio = g.m * g.inv_a;
  return bits(min(s1 * s1 + ratio * y1 * y1, s2 * s2 + ratio * y2 * y2) <= g.level * g.inv_a);
}

// Pairs are blended a few at a time: alphas of all their blocks first, then the compositing. Each of the two loops is short
// enough for the processor to overlap its rounds; in one loop they would wait for each other.
constexpr int PAIRS_AT_ONCE = 8;

// Blocks in which some ray goes on. T: transmittance of each pixel; negative: the ray has ended (or the pixel is outside of
// the image).
INLINE uint32_t alive_blocks(const Lanes (&T)[BLOCKS]) {
  uint32_t alive = 0;
  for (int b = 0; b < BLOCKS; b++) alive |= (uint32_t)any(T[b] > 0.f) << b;
  return alive;
}

// Calls f(lane, index in the image) for the pixels of a block that lie on the image.
template <class F>
INLINE void for_pixels(int block, int X, int Y, int width, int height, F f) {
  const int x = X + block % 4 * 4, y = Y + block / 4 * 4;
  const size_t first = (size_t)y * width + x;
  if (x + BLOCK <= width && y + BLOCK <= height) {
    for (int i = 0; i < LANES; i++) f(i, first + (size_t)(i / 4) * width + i % 4);
  } else {
    for (int i = 0; i < LANES; i++)
      if (x + i % 4 < width && y + i / 4 < height) f(i, first + (size_t)(i / 4) * width + i % 4);
  }
}

// Writes for each pair the blocks that it visited, for the backward pass, and whether it visited any. Returns how many pairs
// it took until all rays had ended. With COUNT, adds to `contributions` the pixels that they changed.
template <bool COUNT>
static int blend_forward(const Footprint* footprints, const Pair* pair, const Pair* end, int X, int Y, int width, int height,
                         uint16_t* visited, uint8_t* reached, float* color, float* alpha_out, float* depth,
                         long long& contributions) {
  Lanes T[BLOCKS], R[BLOCKS], G[BLOCKS], B[BLOCKS], D[BLOCKS];
  for (int b = 0; b < BLOCKS; b++) {
    R[b] = G[b] = B[b] = D[b] = Lanes{}, T[b] = broadcast(-1.f);
    for_pixels(b, X, Y, width, height, [&](int i, size_t) { T[b][i] = 1.f; });
  }
  const Grid grid(X, Y);
  Layer layers[PAIRS_AT_ONCE];
  Lanes alphas[PAIRS_AT_ONCE * BLOCKS];
  uint32_t work[PAIRS_AT_ONCE * BLOCKS + LANES];
  const Pair* const begin = pair;
  for (uint32_t alive = alive_blocks(T); pair < end && alive; alive = alive_blocks(T)) {
    int count = 0;
    for (int n = 0; n < PAIRS_AT_ONCE && pair < end; n++, pair++) {
      const Footprint& g = footprints[pair->footprint_index];
      if (pair + 6 < end) __builtin_prefetch(&footprints[pair[6].footprint_index]);
      const Lanes dx = grid.block_x - g.x, dy = grid.block_y - g.y;
      uint32_t visit = touched_blocks(g, dx, dy) & alive;
      *visited++ = (uint16_t)visit;
      reached[pair->slot] = visit != 0;
      layers[n].set(g, grid, dx, dy);
      count += list_bits(visit, n * BLOCKS, work + count);
    }
    for (int i = 0; i < count; i++) alphas[i] = layers[work[i] / BLOCKS].alpha(work[i] % BLOCKS, grid);
    for (int i = 0; i < count; i++) {
      const Layer& layer = layers[work[i] / BLOCKS];
      const int b = work[i] % BLOCKS;
      Lanes a = alphas[i];
      a = keep(min(a, broadcast(ALPHA_MAX)), a >= ALPHA_MIN);
      Lanes t = T[b], w = a * t, after = t - w;
      Mask ended = after < TRANSMITTANCE_STOP;
      w = keep(w, ~ended);
      if (COUNT) contributions += __builtin_popcount(bits(w > 0.f));
      T[b] = select(ended, minus_abs(t), after);
      R[b] += w * layer.red, G[b] += w * layer.green, B[b] += w * layer.blue, D[b] += w * layer.z;
    }
  }
  for (int b = 0; b < BLOCKS; b++) {
    T[b] = 1.f - abs(T[b]);
    for_pixels(b, X, Y, width, height, [&](int i, size_t k) {
      color[3 * k] = R[b][i], color[3 * k + 1] = G[b][i], color[3 * k + 2] = B[b][i];
      depth[k] = D[b][i], alpha_out[k] = T[b][i];
    });
  }
  return (int)(pair - begin);
}

struct Images {
  const float *color, *alpha, *depth;
};

// Slots are written once, by one thread. GENRE_ABLATE_DETERMINISM, for timing only: each footprint has one slot, to which
// threads add in a race.
INLINE void store_sums(Lanes* slot, const Lanes& sum) {
#ifdef GENRE_ABLATE_DETERMINISM
  *slot += sum;
#else
  stream(slot, sum);
#endif
}

// Also front to back: what lies behind a layer is the pixel's value minus what came so far, so no list per pixel is needed.
// The sums of a pair go to a slot of their own and are added later: no atomics, the same bits at any thread count.
// With RESIDUALS also how much of `residual` [H, W, 3] each layer covers: the sums of w r, w |r|^2 and w, times view_weight.
template <bool RESIDUALS>
static void blend_backward(const Footprint* footprints, const Pair* pair, const Pair* end, int X, int Y, int width, int height,
                           const uint16_t* visited, Images out, Images grad, const float* residual, float view_weight,
                           Lanes* slots) {
  Lanes T[BLOCKS], behind[BLOCKS], vr[BLOCKS], vg[BLOCKS], vb[BLOCKS], vd[BLOCKS];
  Lanes rr[RESIDUALS ? BLOCKS : 1], rg[RESIDUALS ? BLOCKS : 1], rb[RESIDUALS ? BLOCKS : 1];
  for (int b = 0; b < BLOCKS; b++) {
    if constexpr (RESIDUALS) {
      rr[b] = rg[b] = rb[b] = Lanes{};
      for_pixels(b, X, Y, width, height, [&](int i, size_t k) {
        rr[b][i] = residual[3 * k], rg[b][i] = residual[3 * k + 1], rb[b][i] = residual[3 * k + 2];
      });
    }
    Lanes red{}, green{}, blue{}, z{}, alpha{}, v_alpha{};
    vr[b] = vg[b] = vb[b] = vd[b] = Lanes{}, T[b] = broadcast(-1.f);
    for_pixels(b, X, Y, width, height, [&](int i, size_t k) {
      T[b][i] = 1.f;
      vr[b][i] = grad.color[3 * k], vg[b][i] = grad.color[3 * k + 1], vb[b][i] = grad.color[3 * k + 2];
      red[i] = out.color[3 * k], green[i] = out.color[3 * k + 1], blue[i] = out.color[3 * k + 2];
      vd[b][i] = grad.depth[k], v_alpha[i] = grad.alpha[k], z[i] = out.depth[k], alpha[i] = out.alpha[k];
    });
    behind[b] = vr[b] * red + vg[b] * green + vb[b] * blue + vd[b] * z - (1.f - alpha) * v_alpha;
  }
  const Grid grid(X, Y);
  Layer layers[PAIRS_AT_ONCE];
  Lanes alphas[PAIRS_AT_ONCE * BLOCKS], ws[PAIRS_AT_ONCE * BLOCKS];
  uint32_t work[PAIRS_AT_ONCE * BLOCKS + LANES], slot[PAIRS_AT_ONCE];
  int stop[PAIRS_AT_ONCE];
  while (pair < end) {
    int count = 0, n = 0;
    for (; n < PAIRS_AT_ONCE && pair < end; pair++) {
      uint32_t visit = *visited++;
      if (pair + 6 < end) __builtin_prefetch(&footprints[pair[6].footprint_index]);
      if (!visit) continue;
      const Footprint& g = footprints[pair->footprint_index];
      layers[n].set(g, grid, grid.block_x - g.x, grid.block_y - g.y);
#ifdef GENRE_ABLATE_DETERMINISM
      slot[n] = pair->footprint_index;
#else
      slot[n] = pair->slot;
#endif
      count += list_bits(visit, n * BLOCKS, work + count);
      stop[n++] = count;
    }
    for (int i = 0; i < count; i++) alphas[i] = layers[work[i] / BLOCKS].alpha(work[i] % BLOCKS, grid);
    for (int i = 0; i < count; i++) {
      const Layer& layer = layers[work[i] / BLOCKS];
      const int b = work[i] % BLOCKS;
      Lanes a = alphas[i];
      Mask drawn = a >= ALPHA_MIN, free = a < ALPHA_MAX;
      a = keep(min(a, broadcast(ALPHA_MAX)), drawn);
      Lanes t = T[b], w = a * t, after = t - w;
      Mask ended = after < TRANSMITTANCE_STOP;
      w = keep(w, ~ended);
      T[b] = select(ended, minus_abs(t), after);
      Lanes wq = w * (layer.red * vr[b] + layer.green * vg[b] + layer.blue * vb[b] + layer.z * vd[b]);
      Lanes rest = behind[b] - wq;
      behind[b] = rest;
      ws[i] = w;
      alphas[i] = keep(wq - a * rest * reciprocal(1.f - a), ~ended & free & drawn);  // alpha dL/dalpha
    }
    for (int i = 0, k = 0; k < n; k++) {
      const Layer& layer = layers[k];
      Lanes sum_v{}, sum_s{}, sum_ss{}, sum_sy{}, sum_y{}, sum_yy{}, red{}, green{}, blue{}, z{};
      Lanes residual_red{}, residual_green{}, residual_blue{}, residual_square{}, weight{};
      for (; i < stop[k]; i++) {
        const int b = work[i] % BLOCKS;
        Lanes w = ws[i], v = alphas[i];
        red += w * vr[b], green += w * vg[b], blue += w * vb[b], z += w * vd[b];
        Lanes s = layer.s_at(b), dy = layer.dy_at(b, grid), vs = v * s, vy = v * dy;
        sum_v += v, sum_s += vs, sum_y += vy, sum_ss += vs * s, sum_sy += vs * dy, sum_yy += vy * dy;
        if constexpr (RESIDUALS) {
          Lanes wr = w * rr[b], wg = w * rg[b], wb = w * rb[b];
          residual_red += wr, residual_green += wg, residual_blue += wb, weight += w;
          residual_square += wr * rr[b] + wg * rg[b] + wb * rb[b];
        }
      }
      if constexpr (RESIDUALS)
        store_sums(&slots[slot[k]],
                   sums({sum_v, sum_s, sum_ss, sum_sy, sum_y, sum_yy, red, green, blue, z, view_weight * residual_red,
                         view_weight * residual_green, view_weight * residual_blue, view_weight * residual_square,
                         view_weight * weight}));
      else
        store_sums(&slots[slot[k]], sums({sum_v, sum_s, sum_ss, sum_sy, sum_y, sum_yy, red, green, blue, z}));
    }
  }
  stream_end();
}
