// The longitudinal force (N) of VDrift's Pacejka tyre (CarTire1, GPL 3) for many parameter vectors.
// tyre.toml says how it is compiled.
#include <algorithm>

#include "cartire1.h"
#include "cartirebase.h"

extern "C" void tyre(int k, int n, const double *b, const double *slip, const double *load, double *pull)
{
    CarTire1 tire;
    std::fill_n(tire.lateral, 15, 1.0); // of no effect without lateral slip, but not unset
    std::fill_n(tire.combining, 4, 1.0);
    for (int i = 0; i < k; ++i) {
        std::copy_n(b + 11 * i, 11, tire.longitudinal);
        for (int j = 0; j < n; ++j) {
            CarTireState state;
            state.friction = 1.0;
            tire.ComputeState(load[j], 10.0 / (1.0 - slip[j]), 10.0, 0.0, state); // m/s
            pull[n * i + j] = state.fx;
        }
    }
}
