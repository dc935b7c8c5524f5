// Update of the upper factor R of a positive definite matrix for a few added rows: R'^T R' = R^T R + Phi^T Phi.
//
// Householder reflections of (R_j, x_1, ..., x_r) set the added rows x to zero, column by column. Each column
// takes one pass over row j of R and the added rows, which stay in the cache.

#include <algorithm>
#include <cmath>
#include <cstdint>

namespace {

using Index = std::int64_t;

constexpr Index GROUP = 8;

template <int ROWS>
void reflect(double r, double* row, double* __restrict__ X, Index n, Index j) {
    double square = 0.0, v[ROWS];
    for (int k = 0; k < ROWS; ++k) square += X[k * n + j] * X[k * n + j];
    if (square == 0.0) return;
    const double norm = std::copysign(std::sqrt(r * r + square), r), sum = r + norm, tau = sum / norm;
    for (int k = 0; k < ROWS; ++k) v[k] = X[k * n + j] / sum;
    row[j] = norm;
#pragma GCC ivdep
    for (Index i = j + 1; i < n; ++i) {
        double w = row[i];
        for (int k = 0; k < ROWS; ++k) w += v[k] * X[k * n + i];
        w *= tau;
        row[i] = w - row[i];
        for (int k = 0; k < ROWS; ++k) X[k * n + i] -= v[k] * w;
    }
}

template <int ROWS>
void add_rows(const double* R, double* result, double* X, Index n) {
    for (Index j = 0; j < n; ++j) {
        double* const row = result + j * n;
        if (R != result) {
            std::fill(row, row + j, 0.0);
            std::copy(R + j * n + j, R + (j + 1) * n, row + j);
        }
        reflect<ROWS>(row[j], row, X, n, j);
    }
}

}  // namespace

// R and the result are (n, n), Phi is (rows, n), all row-major. Phi is overwritten.
extern "C" void extend(const double* R, double* result, double* Phi, Index n, Index rows) {
    constexpr decltype(&add_rows<1>) of[GROUP] = {add_rows<1>, add_rows<2>, add_rows<3>, add_rows<4>,
                                                  add_rows<5>, add_rows<6>, add_rows<7>, add_rows<8>};
    for (Index first = 0; first < rows; first += GROUP) {
        of[std::min(GROUP, rows - first) - 1](first ? result : R, result, Phi + first * n, n);
    }
}
