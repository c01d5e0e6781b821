#include "neighbours.h"

#include <algorithm>
#include <limits>
#include <numeric>
#include <vector>

#include "pool.h"

namespace nerfvol {
namespace {

constexpr int64_t kLeaf = 16;

// Points in the order of the tree: a range of more than kLeaf is split in the middle along the longer side of its box.
class Tree {
public:
    Tree(const double* points, int64_t n) : order_(size_t(n)), points_(points), axis_(size_t(n), 0) {
        std::iota(order_.begin(), order_.end(), 0);
        split(0, n);
    }

    struct Found {
        double* squared;
        int32_t* index;
        int k;
        double worst() const { return squared[k - 1]; }
        void offer(double d, int32_t i) {
            if (d > worst() || (d == worst() && index[k - 1] >= 0 && i > index[k - 1])) return;
            int at = k - 1;
            for (; at > 0 && (squared[at - 1] > d || (squared[at - 1] == d && index[at - 1] > i)); --at) {
                squared[at] = squared[at - 1];
                index[at] = index[at - 1];
            }
            squared[at] = d;
            index[at] = i;
        }
    };

    void find(const double* q, int32_t without, Found& found) const { find(0, int64_t(order_.size()), q, without, found); }

private:
    void split(int64_t begin, int64_t end) {
        if (end - begin <= kLeaf) return;
        double low[3], high[3];
        for (int k = 0; k < 3; ++k) low[k] = high[k] = at(begin)[k];
        for (int64_t i = begin + 1; i < end; ++i)
            for (int k = 0; k < 3; ++k) {
                low[k] = std::min(low[k], at(i)[k]);
                high[k] = std::max(high[k], at(i)[k]);
            }
        int axis = 0;
        for (int k = 1; k < 3; ++k)
            if (high[k] - low[k] > high[axis] - low[axis]) axis = k;
        const int64_t middle = begin + (end - begin) / 2;
        std::nth_element(order_.begin() + begin, order_.begin() + middle, order_.begin() + end, [&](int32_t a, int32_t b) {
            const double x = points_[3 * int64_t(a) + axis], y = points_[3 * int64_t(b) + axis];
            return x < y || (x == y && a < b);
        });
        axis_[size_t(middle)] = int8_t(axis);
        split(begin, middle);
        split(middle + 1, end);
    }

    void find(int64_t begin, int64_t end, const double* q, int32_t without, Found& found) const {
        if (end - begin <= kLeaf) {
            for (int64_t i = begin; i < end; ++i) look(i, q, without, found);
            return;
        }
        const int64_t middle = begin + (end - begin) / 2;
        const int axis = axis_[size_t(middle)];
        const double across = q[axis] - at(middle)[axis];
        find(across < 0 ? begin : middle + 1, across < 0 ? middle : end, q, without, found);
        look(middle, q, without, found);
        if (across * across <= found.worst()) find(across < 0 ? middle + 1 : begin, across < 0 ? end : middle, q, without, found);
    }

    void look(int64_t i, const double* q, int32_t without, Found& found) const {
        const int32_t index = order_[size_t(i)];
        if (index == without) return;
        const double* p = at(i);
        const double x = p[0] - q[0], y = p[1] - q[1], z = p[2] - q[2];
        found.offer(x * x + y * y + z * z, index);
    }

    const double* at(int64_t i) const { return points_ + 3 * int64_t(order_[size_t(i)]); }

    std::vector<int32_t> order_;
    const double* points_;
    std::vector<int8_t> axis_;  // of the point in the middle of a range
};

}  // namespace

void nearest(const double* points, int64_t n, const double* queries, int64_t m, int k, double* squared, int32_t* index) {
    const Tree tree(points, n);
    std::fill(squared, squared + m * k, std::numeric_limits<double>::infinity());
    std::fill(index, index + m * k, -1);
    constexpr int64_t kRun = 1024;
    parallel_for(int((m + kRun - 1) / kRun), [&](int run, int) {
        for (int64_t i = run * kRun; i < std::min((run + 1) * kRun, m); ++i) {
            Tree::Found found{squared + i * k, index + i * k, k};
            tree.find((queries ? queries : points) + 3 * i, queries ? -1 : int32_t(i), found);
        }
    });
}

}  // namespace nerfvol
