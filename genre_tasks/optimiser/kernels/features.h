// What the network is told about each Gaussian (features.py is its oracle), and Adam's direction (state.py's).
#pragma once
#include <algorithm>
#include <vector>

#include "rows.h"

constexpr int STRIDE = 80, QUAT = 6, FIXED = 4, TIMES = 4;
constexpr int GROUPS = 5, GROUP_STARTS[GROUPS + 1] = {0, 3, 6, 10, 11, ATTRIBUTES};  // means, scales, quats, opacity, colour
constexpr float LOG10_2_HALF = 0.150514998f;
static_assert(VARYING + RESIDUALS <= STRIDE, "a row of features");

// The state and what comes of it; pointers and 64-bit numbers only, in the order of fused_library.py.
struct Now {
  int64_t count;
  const float *offsets, *first, *second, *seen, *seen_now, *gradient;  // [N, 14], seen and seen_now [N]
  const float* by_seen;                                                // [counts, 3]: 1 - decay^n of both moments, log1p(n) / 3
  int64_t counts;
  const float* times;  // [TIMES]: the features behind the varying ones
  const float* rates;  // [14], their sign and the schedule included
  float* delta;        // [N, 14]
  const float *residuals, *part;  // [N, RESIDUALS] or null; [1] of the schedule
};

INLINE float by_share(const Now& now, size_t i) { return 1.f / (now.residuals[RESIDUALS * i + 4] + SHARE_FLOOR_PX); }

// What moves the colours towards the mean residual.
INLINE Lanes relaxed(const Now& now, size_t i, float relaxation) {
  const float factor = *now.part * (1.f + relaxation) * by_share(now, i);
  Lanes r{};
  for (int k = 0; k < 3; k++) r[GROUP_STARTS[4] + k] = factor * now.residuals[RESIDUALS * i + k];
  return r;
}

INLINE const float* counted(const Now& now, size_t i) {
  const int64_t n = (int64_t)now.seen[i];
  return now.by_seen + 3 * std::min(std::max(n, (int64_t)0), now.counts - 1);
}

INLINE Lanes deviation(const Now& now, size_t i, const float* by_seen) {
  return sqrt(load_attributes(now.second + ATTRIBUTES * i) / broadcast(by_seen[1])) + DEVIATION_FLOOR;
}

INLINE Lanes direction(const Now& now, size_t i, const float* by_seen, const Lanes& deviation) {
  return bounded(load_attributes(now.first + ATTRIBUTES * i) / broadcast(by_seen[0]) / deviation, -6.f, 6.f);
}

// Sums of squared deviations of what has been seen, and how many Gaussians that are.
struct Usual {
  float sums[LANES];
  int64_t seen;
};

static Usual sum_of_squares(const Now& now, size_t begin, size_t end) {
  Lanes sums{};
  Usual out{};
  for (size_t i = begin; i < end; i++) {
    if (!(now.seen[i] > 0)) continue;
    const Lanes d = deviation(now, i, counted(now, i));
    sums += d * d;
    out.seen++;
  }
  store(out.sums, sums);
  return out;
}

// 1 / (root mean square of each attribute group), a lane for each attribute.
static Lanes inverse_usual(const std::vector<Usual>& parts) {
  double total[LANES] = {};
  int64_t seen = 0;
  for (const Usual& part : parts) {
    for (int c = 0; c < ATTRIBUTES; c++) total[c] += part.sums[c];
    seen += part.seen;
  }
  Lanes out{};
  for (int g = 0; g < GROUPS; g++) {
    const int begin = GROUP_STARTS[g], end = GROUP_STARTS[g + 1];
    double sum = 0;
    for (int c = begin; c < end; c++) sum += total[c];
    const float usual = (float)std::sqrt(sum / (double)(std::max(seen, (int64_t)1) * (end - begin)));
    for (int c = begin; c < end; c++) out[c] = 1.f / (usual + 1e-30f);
  }
  return out;
}

// The varying features of Gaussian i into x, which has room for STRIDE; its direction also into now.delta. `base` [N, 14] is
// what offsets are added to, `fixed` [N, 4] what never changes.
INLINE void features(const Now& now, const float* base, const float* fixed, const Lanes& inverse_usual, size_t i, float* x) {
  constexpr float ALL = INFINITY;
  static const float SCALE[LANES] = {1 / 3.f, 1 / 3.f, 1 / 3.f, .5f, .5f, .5f, 1, 1, 1, 1, .25f, 1, 1, 1, 0, 0};
  static const float LIMIT[LANES] = {3, 3, 3, 3, 3, 3, ALL, ALL, ALL, ALL, ALL, ALL, ALL, ALL, 0, 0};
  const float* by_seen = counted(now, i);
  const size_t at = ATTRIBUTES * i;
  const Lanes spread = deviation(now, i, by_seen), step = direction(now, i, by_seen, spread);
  store_attributes(now.delta + at, step);
  // Each row of sixteen overwrites the last two of the one before, which are nothing.
  store(x, bounded(step, -4.f, 4.f));
  store(x + 14, bounded(load_attributes(now.gradient + at) / spread, -4.f, 4.f) * .5f);
  store(x + 28, log2(bounded(spread * inverse_usual, 1e-4f, 1e4f)) * (now.seen[i] > 0 ? LOG10_2_HALF : 0.f));
  const Lanes limit = load(LIMIT), moved = (load_attributes(base + at) + load_attributes(now.offsets + at)) * load(SCALE);
  store(x + 42, bounded(moved, -limit, limit));
  float* q = x + 42 + QUAT;
  const float length = std::sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
  const float inverse = 1 / std::max(length, 1e-12f);
  for (int k = 0; k < 4; k++) q[k] *= inverse;
  std::memcpy(x + 56, fixed + FIXED * i, 4 * FIXED);
  x[60] = now.seen_now[i];
  x[61] = by_seen[2];
  if (!now.residuals) return;
  const float *residual = now.residuals + RESIDUALS * i, inverse_share = by_share(now, i);
  auto within = [](float v, float low, float high) { return v < low ? low : v > high ? high : v; };  // NaN stays NaN
  for (int k = 0; k < 3; k++) x[VARYING + k] = within(5.f * residual[k] * inverse_share, -2.f, 2.f);
  x[VARYING + 3] = within(5.f * std::sqrt(residual[3] * inverse_share), 0.f, 4.f);
  x[VARYING + 4] = std::log1p(residual[4]) * .25f;
}
