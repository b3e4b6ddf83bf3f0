// Front-to-back compositing of one 16x16 tile, forward and backward. Row by row: alpha along y is a Gaussian in y, so
// going down one row is two multiplications instead of an exponential.
#pragma once
#include "kernel_project.h"

constexpr int TILE = LANES;

struct Pair {
  uint32_t rank, slot;  // place in depth order; place of the pair's gradient, in input order
};

// Rows [first, last] of the tile that the footprint touches. Clamped as floats: a huge footprint overflows an int.
INLINE void rows_of(const Footprint& g, int tile_y, int& first, int& last) {
  first = (int)std::max(0.f, std::min(float(TILE), std::ceil(g.y - g.half_y - 0.5f - tile_y)));
  last = (int)std::min(TILE - 1.f, std::max(-1.f, std::floor(g.y + g.half_y - 0.5f - tile_y)));
}

// Alpha of one footprint down the rows of a tile.
struct RowAlpha {
  Lanes dx, dy0, u, bx, value, ratio;
  float c, ratio_ratio;
  bool direct;

  __attribute__((always_inline)) RowAlpha(const Footprint& g, const Lanes& xs, const Lanes& ys, int first) {
    dx = xs - g.x, dy0 = ys - g.y, u = g.log2_opacity - (g.a * dx) * dx, bx = g.b * dx, c = g.c;
    Lanes dy = dy0 + (float)first;
    Lanes p = min(u - dy * (bx + c * dy), broadcast(g.log2_opacity));  // rounding far from the centre must not exceed the peak
    direct = any(p < -100.f);  // the recurrence would start from an underflow (needles)
    value = exp2(p);
    ratio = exp2(min(broadcast(126.f), -(bx + c * (2.f * dy + 1.f))));
    ratio_ratio = std::exp2(-2 * c);
  }
  __attribute__((always_inline)) Lanes next(const Footprint& g, const Lanes& dy) {
    Lanes alpha = value;
    value = value * ratio, ratio = ratio * ratio_ratio;
    if (__builtin_expect(direct, 0)) alpha = exp2(min(u - dy * (bx + c * dy), broadcast(g.log2_opacity)));
    return alpha;
  }
};

// Transmittance of each pixel; negative: the ray has ended (or the pixel is outside of the image).
INLINE bool all_ended(const Lanes (&T)[TILE]) {
  Lanes m = T[0];
  for (int r = 1; r < TILE; r++) m = max(m, T[r]);
  return !any(m > 0.f);
}

INLINE Lanes lane_centers(int origin) {
  Lanes x;
  for (int i = 0; i < LANES; i++) x[i] = origin + i + 0.5f;
  return x;
}

static void blend_forward(const Footprint* sorted, const Pair* pair, const Pair* end, int X, int Y, int width, int height,
                          float* color, float* alpha_out, float* depth) {
  Lanes T[TILE], R[TILE], G[TILE], B[TILE], D[TILE];
  for (int r = 0; r < TILE; r++) {
    R[r] = G[r] = B[r] = D[r] = Lanes{};
    for (int i = 0; i < LANES; i++) T[r][i] = X + i < width && Y + r < height ? 1.f : -1.f;
  }
  const Lanes xs = lane_centers(X), ys = broadcast(Y + 0.5f);
  for (int i = 0; pair < end; pair++, i++) {
    const Footprint& g = sorted[pair->rank];
    if (pair + 6 < end) __builtin_prefetch(&sorted[pair[6].rank]);
    int first, last;
    rows_of(g, Y, first, last);
    RowAlpha row(g, xs, ys, first);
    for (int r = first; r <= last; r++) {
      Lanes a = row.next(g, row.dy0 + (float)r);
      a = keep(min(a, broadcast(ALPHA_MAX)), a >= ALPHA_MIN);
      Lanes t = T[r], w = a * t, after = t - w;
      Mask ended = after < TRANSMITTANCE_STOP;
      w = keep(w, ~ended);
      T[r] = select(ended, minus_abs(t), after);
      R[r] += w * g.red, G[r] += w * g.green, B[r] += w * g.blue, D[r] += w * g.z;
    }
    if ((i & 7) == 7 && all_ended(T)) break;
  }
  for (int r = 0; r < TILE && Y + r < height; r++)
    for (int i = 0; i < LANES && X + i < width; i++) {
      size_t k = (size_t)(Y + r) * width + X + i;
      color[3 * k] = R[r][i], color[3 * k + 1] = G[r][i], color[3 * k + 2] = B[r][i];
      depth[k] = D[r][i], alpha_out[k] = 1 - std::fabs(T[r][i]);
    }
}

struct Images {
  const float *color, *alpha, *depth;
};

// Also front to back: what lies behind a layer is the pixel's value minus what came so far, so no list per pixel is kept.
// The ten sums of a pair go to its own slot and are added later: no atomics, the same bits at any thread count.
static void blend_backward(const Footprint* sorted, const Pair* pair, const Pair* end, int X, int Y, int width, int height,
                           Images out, Images grad, Lanes* slots) {
  Lanes T[TILE], behind[TILE], vr[TILE], vg[TILE], vb[TILE], vd[TILE];
  for (int r = 0; r < TILE; r++) {
    behind[r] = vr[r] = vg[r] = vb[r] = vd[r] = Lanes{};
    for (int i = 0; i < LANES; i++) {
      bool inside = X + i < width && Y + r < height;
      T[r][i] = inside ? 1.f : -1.f;
      if (!inside) continue;
      size_t k = (size_t)(Y + r) * width + X + i;
      const float *v = grad.color + 3 * k, *o = out.color + 3 * k;
      vr[r][i] = v[0], vg[r][i] = v[1], vb[r][i] = v[2], vd[r][i] = grad.depth[k];
      behind[r][i] = v[0] * o[0] + v[1] * o[1] + v[2] * o[2] + grad.depth[k] * out.depth[k] - (1 - out.alpha[k]) * grad.alpha[k];
    }
  }
  const Lanes xs = lane_centers(X), ys = broadcast(Y + 0.5f);
  for (int i = 0; pair < end; pair++, i++) {
    const Footprint& g = sorted[pair->rank];
    if (pair + 6 < end) __builtin_prefetch(&sorted[pair[6].rank]);
    int first, last;
    rows_of(g, Y, first, last);
    RowAlpha row(g, xs, ys, first);
    Lanes s0{}, sy{}, syy{}, red{}, green{}, blue{}, z{};
    for (int r = first; r <= last; r++) {
      Lanes dy = row.dy0 + (float)r, a = row.next(g, dy);
      Mask drawn = a >= ALPHA_MIN, free = a < ALPHA_MAX;
      a = keep(min(a, broadcast(ALPHA_MAX)), drawn);
      Lanes t = T[r], w = a * t, after = t - w;
      Mask ended = after < TRANSMITTANCE_STOP;
      w = keep(w, ~ended);
      T[r] = select(ended, minus_abs(t), after);
      Lanes wq = w * (g.red * vr[r] + g.green * vg[r] + g.blue * vb[r] + g.z * vd[r]);
      Lanes rest = behind[r] - wq;
      behind[r] = rest;
      red += w * vr[r], green += w * vg[r], blue += w * vb[r], z += w * vd[r];
      Lanes v = keep(wq - a * rest * (1.f / (1.f - a)), ~ended & free & drawn);  // alpha dL/dalpha
      s0 += v;
      Lanes vy = v * dy;
      sy += vy, syy += vy * dy;
    }
    Lanes sx = s0 * row.dx;
    stream(&slots[pair->slot], sums({s0, sx, sx * row.dx, sy * row.dx, sy, syy, red, green, blue, z}));
    if ((i & 7) == 7 && all_ended(T)) {
      pair++;
      break;
    }
  }
  for (; pair < end; pair++) stream(&slots[pair->slot], Lanes{});
  stream_end();
}
