// The network's features of each Gaussian (features.py is its oracle), and Adam's direction (state.py is its oracle).
#pragma once
#include <algorithm>
#include <vector>

#include "rows.h"

constexpr int STRIDE = 80, QUAT = 6, STATIC_FEATURES = 4, SCHEDULE_FEATURES = 4;
constexpr int GROUPS = 5, GROUP_STARTS[GROUPS + 1] = {0, 3, 6, 10, 11, ATTRIBUTES};  // means, scales, quats, opacity, colour
constexpr float LOG10_2_HALF = 0.150514998f;
static_assert(VARYING_FEATURES + IMAGE_RESIDUALS <= STRIDE, "a row of features");

// The state of N Gaussians in one iteration, and where the step is written. Pointers and 64-bit numbers only, in the order
// of library.py.
struct StepInputs {
  int64_t count;                                           // N
  const float *offsets, *first_moment, *second_moment;     // [N, 14]
  const float *visit_count, *visible, *gradient;           // [N], [N], [N, 14]
  const float* by_count;                                   // [counts, 3]: 1 - decay^n of both moments, log1p(n) / 3
  int64_t counts;
  const float* schedule_features;  // [SCHEDULE_FEATURES]: the features behind the varying ones, the same for all Gaussians
  const float* signed_rates;       // [14]: negative learning rates, with the scale of the schedule in them
  float* delta;                    // [N, 14]
  const float *image_residuals, *lr_scale;  // [N, IMAGE_RESIDUALS] or null; [1] of the schedule
};

INLINE float inverse_weight(const StepInputs& in, size_t i) {
  return 1.f / (in.image_residuals[IMAGE_RESIDUALS * i + 4] + WEIGHT_FLOOR_PX);
}

// Moves the colours towards the mean residual.
INLINE Lanes residual_step(const StepInputs& in, size_t i, float relaxation) {
  const float factor = *in.lr_scale * (1.f + relaxation) * inverse_weight(in, i);
  Lanes r{};
  for (int k = 0; k < 3; k++) r[GROUP_STARTS[4] + k] = factor * in.image_residuals[IMAGE_RESIDUALS * i + k];
  return r;
}

// What depends on how often a Gaussian was seen.
INLINE const float* factors_of_count(const StepInputs& in, size_t i) {
  const int64_t n = (int64_t)in.visit_count[i];
  return in.by_count + 3 * std::min(std::max(n, (int64_t)0), in.counts - 1);
}

INLINE Lanes rms_gradient(const StepInputs& in, size_t i, const float* factors) {
  return sqrt(load_attributes(in.second_moment + ATTRIBUTES * i) / broadcast(factors[1])) + RMS_FLOOR;
}

INLINE Lanes adam_direction(const StepInputs& in, size_t i, const float* factors, const Lanes& rms) {
  return bounded(load_attributes(in.first_moment + ATTRIBUTES * i) / broadcast(factors[0]) / rms, -6.f, 6.f);
}

// Sums of squared root mean squares over the Gaussians that were seen, and how many these are.
struct SquaredRms {
  float sums[LANES];
  int64_t visited;
};

static SquaredRms sum_squared_rms(const StepInputs& in, size_t begin, size_t end) {
  Lanes sums{};
  SquaredRms out{};
  for (size_t i = begin; i < end; i++) {
    if (!(in.visit_count[i] > 0)) continue;
    const Lanes rms = rms_gradient(in, i, factors_of_count(in, i));
    sums += rms * rms;
    out.visited++;
  }
  store(out.sums, sums);
  return out;
}

// 1 / (root mean square of each attribute group), a lane for each attribute.
static Lanes inverse_group_rms(const std::vector<SquaredRms>& parts) {
  double total[LANES] = {};
  int64_t visited = 0;
  for (const SquaredRms& part : parts) {
    for (int c = 0; c < ATTRIBUTES; c++) total[c] += part.sums[c];
    visited += part.visited;
  }
  Lanes out{};
  for (int g = 0; g < GROUPS; g++) {
    const int begin = GROUP_STARTS[g], end = GROUP_STARTS[g + 1];
    double sum = 0;
    for (int c = begin; c < end; c++) sum += total[c];
    const float rms = (float)std::sqrt(sum / (double)(std::max(visited, (int64_t)1) * (end - begin)));
    for (int c = begin; c < end; c++) out[c] = 1.f / (rms + 1e-30f);
  }
  return out;
}

// Writes the varying features of Gaussian i to x, which has room for STRIDE, and its direction to in.delta as well. `base`
// [N, 14] is what offsets are added to, `fixed` [N, 4] are the features that do not change over the iterations.
INLINE void features(const StepInputs& in, const float* base, const float* fixed, const Lanes& inverse_group_rms, size_t i,
                     float* x) {
  constexpr float ALL = INFINITY;
  static const float SCALE[LANES] = {1 / 3.f, 1 / 3.f, 1 / 3.f, .5f, .5f, .5f, 1, 1, 1, 1, .25f, 1, 1, 1, 0, 0};
  static const float LIMIT[LANES] = {3, 3, 3, 3, 3, 3, ALL, ALL, ALL, ALL, ALL, ALL, ALL, ALL, 0, 0};
  const float* factors = factors_of_count(in, i);
  const size_t at = ATTRIBUTES * i;
  const Lanes rms = rms_gradient(in, i, factors), direction = adam_direction(in, i, factors, rms);
  store_attributes(in.delta + at, direction);
  // Rows of sixteen lanes hold fourteen attributes: each store overwrites the two idle lanes of the one before.
  store(x, bounded(direction, -4.f, 4.f));
  store(x + 14, bounded(load_attributes(in.gradient + at) / rms, -4.f, 4.f) * .5f);
  store(x + 28, log2(bounded(rms * inverse_group_rms, 1e-4f, 1e4f)) * (in.visit_count[i] > 0 ? LOG10_2_HALF : 0.f));
  const Lanes limit = load(LIMIT), scaled = (load_attributes(base + at) + load_attributes(in.offsets + at)) * load(SCALE);
  store(x + 42, bounded(scaled, -limit, limit));
  float* q = x + 42 + QUAT;
  const float length = std::sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
  const float inverse = 1 / std::max(length, 1e-12f);
  for (int k = 0; k < 4; k++) q[k] *= inverse;
  std::memcpy(x + 56, fixed + STATIC_FEATURES * i, 4 * STATIC_FEATURES);
  x[60] = in.visible[i];
  x[61] = factors[2];
  if (!in.image_residuals) return;
  const float *residual = in.image_residuals + IMAGE_RESIDUALS * i, by_weight = inverse_weight(in, i);
  auto within = [](float v, float low, float high) { return v < low ? low : v > high ? high : v; };  // NaN stays NaN
  for (int k = 0; k < 3; k++) x[VARYING_FEATURES + k] = within(5.f * residual[k] * by_weight, -2.f, 2.f);
  x[VARYING_FEATURES + 3] = within(5.f * std::sqrt(residual[3] * by_weight), 0.f, 4.f);
  x[VARYING_FEATURES + 4] = std::log1p(residual[4]) * .25f;
}
