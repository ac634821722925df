// What a controller does with a Lightpage service, as a command line program; `usage` says how.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <filesystem>
#include <fstream>
#include <iostream>
#include <iterator>
#include <map>
#include <sstream>
#include <string>
#include <vector>

#include "lightpage_client.h"

namespace {

using lightpage::Client;
using lightpage::Deadline;
using lightpage::Duration;
namespace v1 = lightpage::v1;

constexpr char kUsage[] = R"(usage: lightpage_example [--target HOST:PORT] [--timeout SECONDS]
                         [--ca FILE --certificate FILE --key FILE] COMMAND ...
  describe                                       what the service is
  decode FRAMES.raw --out FILE [--levels M]      decode the pixels of both frames, in-phase first; FILE gets the symbols
  read PAGE --request-id ID [--out FILE] [--attempt SECONDS]
                                                 read a page of the source, once for each ID
  recalibrate --pages N [--cancel-after SECONDS] start a recalibration and follow it
  watch JOB                                      follow a recalibration
Exit status: 0 done; 1 a job that did not end well; 2 an error, which one line explains; 64 a wrong command line.
)";

struct UsageError {};

// A command line: `--name value` are options, the rest words.
struct Arguments {
  std::vector<std::string> words;
  std::map<std::string, std::string> options;

  Arguments(int count, char** values) {
    for (int i = 1; i < count; ++i) {
      const std::string word = values[i];
      if (word.rfind("--", 0) != 0) {
        words.push_back(word);
      } else if (++i < count) {
        options[word.substr(2)] = values[i];
      } else {
        throw UsageError();
      }
    }
  }

  std::string word(std::size_t index) const {
    if (index >= words.size()) throw UsageError();
    return words[index];
  }

  std::string option(const std::string& name) const {
    if (options.count(name) == 0) throw UsageError();
    return options.at(name);
  }

  std::string option(const std::string& name, const std::string& otherwise) const {
    return options.count(name) == 0 ? otherwise : options.at(name);
  }
};

double number(const std::string& text, double most) {
  std::istringstream stream(text);
  double value = 0;
  if (!(stream >> value) || !stream.eof() || value < 0 || value > most) throw UsageError();
  return value;
}

std::uint32_t whole(const std::string& text) {
  const double value = number(text, UINT32_MAX);
  if (value != std::floor(value)) throw UsageError();
  return static_cast<std::uint32_t>(value);
}

Duration seconds(const std::string& text) { return Duration(number(text, 1e6)); }

std::string read_file(const std::string& path) {
  if (!std::filesystem::is_regular_file(path)) throw std::runtime_error("cannot read " + path + ": no file");
  std::ifstream file(path, std::ios::binary);
  std::string data((std::istreambuf_iterator<char>(file)), std::istreambuf_iterator<char>());
  if (!file) throw std::runtime_error("cannot read " + path);
  return data;
}

void write_file(const std::string& path, const std::string& data) {
  std::ofstream file(path, std::ios::binary);
  file.write(data.data(), static_cast<std::streamsize>(data.size()));
  file.close();
  if (!file) throw std::runtime_error("cannot write " + path);
}

void tell_page(const v1::DecodeReply& page) {
  std::cout << "symbols " << page.rows() << "x" << page.columns() << ", levels " << page.levels() << ", model "
            << page.model_version() << "\n";
  if (page.recalibration_due()) std::cout << "a recalibration is due\n";
}

int describe(Client& client, Deadline deadline) {
  const v1::DescribeReply it = client.describe(deadline);
  std::cout << "service " << it.service_version() << "\n"
            << "model " << it.model().name() << " " << it.model().version() << "\n"
            << "camera " << it.camera().rows_px() << "x" << it.camera().columns_px() << ", " << it.camera().bit_depth()
            << " bits\n"
            << "page " << it.page().rows() << "x" << it.page().columns() << "\n"
            << "source " << it.source() << ", levels " << it.source_levels() << "\n"
            << "chunks of at most " << it.limits().chunk_bytes() << " bytes\n";
  return 0;
}

int decode(Client& client, const Arguments& given, Deadline deadline) {
  const std::string pixels = read_file(given.word(1)), out = given.option("out");
  const std::uint32_t levels = whole(given.option("levels", "0"));
  const v1::DescribeReply service = client.describe(deadline);
  v1::DecodeHeader header;
  header.set_rows_px(service.camera().rows_px());
  header.set_columns_px(service.camera().columns_px());
  header.set_pixel_type(service.camera().pixel_type());
  header.set_bit_depth(service.camera().bit_depth());
  header.mutable_options()->set_levels(levels);
  const v1::DecodeReply page =
      client.decode(header, pixels.data(), pixels.size(), deadline, service.limits().chunk_bytes());
  write_file(out, page.symbols());
  tell_page(page);
  return 0;
}

int read(Client& client, const Arguments& given, Deadline deadline) {
  v1::ReadPageRequest request;
  request.set_page(whole(given.word(1)));
  request.set_request_id(given.option("request-id"));
  const v1::ReadPageReply reply = client.read_page(request, deadline, seconds(given.option("attempt", "10")));
  if (given.options.count("out") != 0) write_file(given.option("out"), reply.decoded().symbols());
  std::cout << "page " << reply.page() << (reply.replayed() ? ", the answer of an earlier call" : "") << "\n";
  tell_page(reply.decoded());
  return 0;
}

void tell_job(const v1::Job& job) {
  std::string state = v1::JobState_Name(job.state());  // empty where this program is older than the state
  const std::string prefix = "JOB_STATE_";
  if (state.rfind(prefix, 0) == 0) state.erase(0, prefix.size());
  std::cout << "job " << job.id() << " " << state;
  if (job.state() == v1::JOB_STATE_RUNNING) {
    std::cout << ": " << job.progress().step() << " " << static_cast<int>(100 * job.progress().fraction()) << "%";
  } else if (job.has_result()) {
    std::cout << ": model " << job.result().model_version() << ", bits a symbol " << job.result().air_before() << " -> "
              << job.result().air_after();
  } else if (job.has_refusal()) {
    const v1::ErrorDetail& why = job.refusal().detail();
    std::cout << ": " << why.thing() << ": got " << why.got() << ", wanted " << why.wanted();
  }
  std::cout << std::endl;  // at once, also where it is read by a program
}

int watch(Client& client, const std::string& id, Deadline deadline) {
  return client.watch_job(id, tell_job, deadline).state() == v1::JOB_STATE_DONE ? 0 : 1;
}

int recalibrate(Client& client, const Arguments& given, Deadline deadline) {
  v1::StartRecalibrationRequest request;
  request.mutable_source()->set_count(whole(given.option("pages")));
  const v1::Job job = client.start_recalibration(request, deadline);
  if (given.options.count("cancel-after") == 0) return watch(client, job.id(), deadline);
  try {
    return watch(client, job.id(), std::min(deadline, lightpage::in(seconds(given.option("cancel-after")))));
  } catch (const lightpage::Error& error) {
    if (error.code != grpc::StatusCode::DEADLINE_EXCEEDED) throw;
  }
  std::cout << "cancelling job " << job.id() << std::endl;
  client.cancel_job(job.id(), deadline);
  return watch(client, job.id(), deadline);
}

void tell_error(const lightpage::Error& error) {
  std::cerr << "error: " << error.what() << " (status " << error.code;
  if (!error.reason.empty()) std::cerr << ", reason " << error.reason;
  if (!error.detail.kind().empty()) std::cerr << ", " << error.detail.kind();
  if (error.detail.reason() != v1::LOSS_REASON_UNSPECIFIED) {
    std::cerr << ", " << v1::LossReason_Name(error.detail.reason());
  }
  if (error.retry_after) std::cerr << ", again in " << error.retry_after->count() << " s";
  for (const auto& [field, wrong] : error.bad_fields)
    if (!field.empty()) std::cerr << ", field " << field;
  for (const auto& [name, value] : error.metadata) std::cerr << ", " << name << "=" << value;
  std::cerr << ")\n";
}

std::string contents(const std::string& path) {
  std::ifstream file(path, std::ios::binary);
  std::ostringstream text;
  if (!file || !(text << file.rdbuf())) throw std::runtime_error(path + ": got no file, wanted one that can be read");
  return text.str();
}

Client connected(const Arguments& given) {
  const auto target = given.option("target", "127.0.0.1:50051");
  if (target.empty()) throw UsageError();
  const std::size_t files = given.options.count("ca") + given.options.count("certificate") + given.options.count("key");
  if (files == 0) return Client(target);
  return Client(target, {contents(given.option("ca")), contents(given.option("certificate")),
                         contents(given.option("key"))});
}

int run(const Arguments& given) {
  const std::string command = given.word(0);
  const Deadline deadline = lightpage::in(seconds(given.option("timeout", "60")));
  Client client = connected(given);
  if (command == "describe") return describe(client, deadline);
  if (command == "decode") return decode(client, given, deadline);
  if (command == "read") return read(client, given, deadline);
  if (command == "recalibrate") return recalibrate(client, given, deadline);
  if (command == "watch") return watch(client, given.word(1), deadline);
  throw UsageError();
}

}  // namespace

int main(int count, char** values) {
  try {
    return run(Arguments(count, values));
  } catch (const UsageError&) {
  } catch (const lightpage::Error& error) {
    tell_error(error);
    return 2;
  } catch (const std::exception& error) {
    std::cerr << "error: " << error.what() << "\n";
    return 2;
  }
  std::cerr << kUsage;
  return 64;
}
