// Single-wheel test rig on the SCM deformable terrain of Project Chrono.
// A rigid cylinder is driven at an imposed forward speed v and an imposed spin w = v / (R (1 - slip)), free to sink
// under an imposed vertical load, its own weight. Forces and sinkage are means over the last 0.1 m of the travel.
//   chrono_wheel rows.csv [setting=value]...      prints pull,torque,sinkage (N, Nm, m), a line for each row
// Columns, in any order: Kphi Kc n cohesion friction janosi slip load. Settings, or columns of these names:
#include <cmath>
#include <fstream>
#include <iostream>
#include <map>
#include <sstream>
#include "chrono/physics/ChSystemSMC.h"
#include "chrono/physics/ChContactMaterialSMC.h"
#include "chrono/physics/ChLinkMotorLinearSpeed.h"
#include "chrono/physics/ChLinkMotorRotationSpeed.h"
#include "chrono/collision/ChCollisionShapeCylinder.h"
#include "chrono/collision/bullet/ChCollisionSystemBullet.h"
#include "chrono/functions/ChFunctionConst.h"
#include "chrono/solver/ChDirectSolverLS.h"
#include "chrono_vehicle/terrain/SCMTerrain.h"
using namespace chrono;

static const double R = 0.25, W = 0.2, G = 9.81, SETTLE = 0.3, WINDOW = 0.1;
static const std::map<std::string, double> DEFAULTS = {
    {"mesh_mm", 20}, {"time_step_ms", 1}, {"speed", 0.2}, {"travel", 0.6}, {"elastic_K", 2e8}, {"damping_R", 3e3},
    {"domain", 1},   // length of SCM's active domain over the wheel's diameter; 0: Chrono's own default
    {"bullet", 0}};  // 1: Bullet's own ray casting

// Bullet's cast of a ray to a cylinder is iterative, with a loose tolerance (errors of some 0.1 mm to 1 cm, which the
// stiff soil turns into noise and into a spurious sinkage); SCM's vertical rays are intersected exactly instead.
struct ExactRays : ChCollisionSystemBullet {
    ChBody* wheel = nullptr;
    bool RayHit(const ChVector3d& from, const ChVector3d& to, ChRayhitResult& r) const override {
        ChVector3d c = wheel->GetPos();
        double dx = from.x() - c.x(), z = c.z() - std::sqrt(std::max(0.0, R * R - dx * dx));
        r.hit = std::abs(dx) < R && std::abs(from.y() - c.y()) <= W / 2 && from.z() <= z && z <= to.z();
        if (!r.hit) return false;
        r.hitModel = wheel->GetCollisionModel().get();
        r.abs_hitPoint.Set(from.x(), from.y(), z);
        r.abs_hitNormal.Set(dx / R, 0, (z - c.z()) / R);
        r.dist_factor = (z - from.z()) / (to.z() - from.z());
        return true;
    }
};

static void run(const std::map<std::string, double>& row) {
    auto get = [&](const char* name) { return row.at(name); };
    double mesh = get("mesh_mm") / 1e3, dt = get("time_step_ms") / 1e3, speed = get("speed");
    ChSystemSMC sys;
    auto rays = chrono_types::make_shared<ExactRays>();
    if (get("bullet")) sys.SetCollisionSystemType(ChCollisionSystem::Type::BULLET);
    else sys.SetCollisionSystem(rays);
    sys.SetNumThreads(1, 1, 1);
    sys.SetGravitationalAcceleration(ChVector3d(0, 0, -G));
    sys.SetSolver(chrono_types::make_shared<ChSolverSparseLU>());

    auto ground = chrono_types::make_shared<ChBody>();
    ground->SetFixed(true);
    auto carriage = chrono_types::make_shared<ChBody>();
    auto wheel = chrono_types::make_shared<ChBody>();
    double m = get("load") / G;
    wheel->SetMass(m);
    wheel->SetInertiaXX(ChVector3d(m * (3 * R * R + W * W) / 12, m * R * R / 2, m * (3 * R * R + W * W) / 12));
    // centred between or on grid lines, such that the grid cells under the wheel make up its width
    double y0 = (int)(W / mesh + 0.5) % 2 == 0 ? mesh / 2 : 0;
    ChVector3d p0(0, y0, R + 1e-3);
    rays->wheel = wheel.get();
    carriage->SetPos(p0);
    wheel->SetPos(p0);
    auto mat = chrono_types::make_shared<ChContactMaterialSMC>();
    wheel->AddCollisionShape(chrono_types::make_shared<ChCollisionShapeCylinder>(mat, R, W), ChFramed(VNULL, QuatFromAngleX(CH_PI_2)));
    wheel->EnableCollision(true);
    sys.AddBody(ground);
    sys.AddBody(carriage);
    sys.AddBody(wheel);

    auto fx = chrono_types::make_shared<ChLinkMotorLinearSpeed>();     // along Z of its frame = world x
    fx->Initialize(carriage, ground, ChFramed(p0, QuatFromAngleY(CH_PI_2)));
    auto rot = chrono_types::make_shared<ChLinkMotorRotationSpeed>();  // about Z of its frame = world y; world z left free
    rot->Initialize(wheel, carriage, ChFramed(p0, QuatFromAngleX(-CH_PI_2)));
    rot->SetSpindleConstraint(true, false, true, true, true);
    auto vfun = chrono_types::make_shared<ChFunctionConst>(0), wfun = chrono_types::make_shared<ChFunctionConst>(0);
    fx->SetSpeedFunction(vfun);
    rot->SetSpeedFunction(wfun);
    sys.AddLink(fx);
    sys.AddLink(rot);

    vehicle::SCMTerrain soil(&sys, false);
    soil.SetSoilParameters(get("Kphi"), get("Kc"), get("n"), get("cohesion"), get("friction"), get("janosi"), get("elastic_K"), get("damping_R"));
    if (get("domain")) soil.AddActiveDomain(carriage, VNULL, ChVector3d(get("domain") * 2 * R, W + 2 * mesh, 4 * R));
    soil.Initialize(4.0, 1.0, mesh);

    double total = SETTLE + get("travel") / speed, from = total - WINDOW / speed, Fx = 0, T = 0, z = 0;
    long N = 0, steps = std::lround(total / dt), start = std::lround(SETTLE / dt), first = std::lround(from / dt);
    for (long i = 0; i < steps; i++) {
        if (i == start) { vfun->SetConstant(speed); wfun->SetConstant(speed / (R * (1 - get("slip")))); }
        sys.DoStepDynamics(dt);
        if (i < first) continue;
        ChVector3d f, t;
        soil.GetContactForceBody(wheel, f, t);
        Fx += f.x(); T -= t.y(); z += R - wheel->GetPos().z(); N++;
    }
    printf("%.3f,%.4f,%.6f\n", Fx / N, T / N, z / N);
    fflush(stdout);
}

int main(int argc, char** argv) {
    std::ifstream file(argc > 1 ? argv[1] : "");
    std::string line, cell;
    if (!std::getline(file, line)) { fprintf(stderr, "usage: %s rows.csv [setting=value]...\n", argv[0]); return 2; }
    std::map<std::string, double> row = DEFAULTS;
    for (int i = 2; i < argc; i++) {
        std::string s = argv[i];
        size_t at = s.find('=');
        if (at == s.npos || !row.count(s.substr(0, at))) { fprintf(stderr, "no setting %s\n", argv[i]); return 2; }
        row[s.substr(0, at)] = std::stod(s.substr(at + 1));
    }
    auto cells = [](std::string text) {
        std::vector<std::string> out;
        if (!text.empty() && text.back() == '\r') text.pop_back();
        std::stringstream is(text);
        for (std::string c; std::getline(is, c, ',');) out.push_back(c);
        return out;
    };
    auto names = cells(line);
    printf("pull,torque,sinkage\n");
    while (std::getline(file, line)) {
        auto values = cells(line);
        if (values.size() != names.size()) { fprintf(stderr, "a row has %zu values for %zu columns\n", values.size(), names.size()); return 2; }
        for (size_t k = 0; k < names.size(); k++) row[names[k]] = std::stod(values[k]);
        run(row);
    }
}
