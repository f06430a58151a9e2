// Run an exported control step from C++.
//
//     build/run_exported_step step-.../step.pt2
//
// The arm moves as it is told; a real loop would read its joints and write to its driver.

#include <ATen/ATen.h>
#include <torch/csrc/inductor/aoti_package/model_package_loader.h>

#include <algorithm>
#include <chrono>
#include <cstdio>
#include <map>
#include <sstream>
#include <string>
#include <vector>

constexpr double dt = 0.002;  // the step the package was exported with [s]

std::vector<double> numbers(const std::string& text) {
  std::vector<double> result;
  // Not `stream >> number`, which cannot read nan.
  std::istringstream stream(text);
  for (std::string word; stream >> word;) result.push_back(std::stod(word));
  return result;
}

// First row of each field of one of the three vectors, and under "" the number of rows.
std::map<std::string, long> rows_of(const std::string& vector, const std::string& layout) {
  std::map<std::string, long> rows;
  long next = 0;
  std::istringstream lines(layout);
  for (std::string line; std::getline(lines, line);) {
    std::istringstream words(line);
    std::string owner, name, dtype, batched;
    words >> owner >> name >> dtype >> batched;
    if (owner != vector) continue;
    rows[name] = next;
    long size = 1;
    for (long extent; words >> extent;) size *= extent;
    next += size;
  }
  rows[""] = next;
  return rows;
}

// A tensor on memory of ours: the step reads and writes it in place.
at::Tensor on(std::vector<double>& memory) {
  return at::from_blob(memory.data(), static_cast<long>(memory.size()), at::kDouble);
}

int main(int argc, char** argv) {
  if (argc != 2) {
    std::fprintf(stderr, "usage: %s PACKAGE\n", argv[0]);
    return 2;
  }
  torch::inductor::AOTIModelPackageLoader loader(argv[1]);
  auto says = loader.get_metadata();
  auto seen = rows_of("observation", says["hrc_learn.layout"]);
  auto said = rows_of("command", says["hrc_learn.layout"]);

  // An arm at rest, the observation of the export, and room for the command.
  std::vector<double> state = numbers(says["hrc_learn.state"]);
  std::vector<double> observation = numbers(says["hrc_learn.observation"]);
  std::vector<double> command(said[""]);
  double* q = &observation[seen["joint_position"]];
  const double* velocity = &command[said["joint_velocity"]];
  const std::vector<at::Tensor> vectors = {on(state), on(observation), on(command)};

  const int joints = 7;
  std::vector<double> micros;
  for (int step = 0; step < 1000; ++step) {
    const auto began = std::chrono::steady_clock::now();
    loader.run(vectors);  // writes the command and the next state
    const std::chrono::duration<double, std::micro> took =
        std::chrono::steady_clock::now() - began;
    micros.push_back(took.count());
    for (int i = 0; i < joints; ++i) q[i] += dt * velocity[i];
  }

  std::printf("joints at");
  for (int i = 0; i < joints; ++i) std::printf(" %.9f", q[i]);
  std::nth_element(micros.begin(), micros.begin() + 500, micros.end());
  std::printf("\nmedian step %.0f us\n", micros[500]);
}
