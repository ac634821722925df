// A client of the Lightpage service. Messages are those of proto/lightpage/v1/lightpage.proto.
//
//   lightpage::Client client("127.0.0.1:50051");
//   const auto deadline = lightpage::in(std::chrono::seconds(60));
//   lightpage::v1::DescribeReply service = client.describe(deadline);
//
// Every call ends by its deadline, and throws lightpage::Error where it does not end well. A service that has too much
// to do says when to come back: the call then waits and asks again, as long as the deadline allows. Calls that may be
// repeated do the same where the service does not answer at all.
//
// A Client may be used by several threads at once.
#pragma once

#include <chrono>
#include <cstddef>
#include <cstdint>
#include <functional>
#include <map>
#include <memory>
#include <optional>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

#include <grpcpp/grpcpp.h>

#include "lightpage/v1/lightpage.grpc.pb.h"

namespace lightpage {

using Clock = std::chrono::system_clock;
using Deadline = Clock::time_point;
using Duration = std::chrono::duration<double>;

// The deadline so many seconds from now.
Deadline in(Duration seconds);

// How a call ended that did not end well.
class Error : public std::runtime_error {
 public:
  // The error of a status; `details` is what the service sent as `grpc-status-details-bin`, `error` as
  // `lightpage-error-bin`. Either may be empty: then the connection failed, or something between has answered.
  Error(grpc::StatusCode code, const std::string& message, const std::string& details, const std::string& error);

  grpc::StatusCode code;
  // Name of an ErrorReason without its prefix, for instance "OVERLOADED"; empty where the service did not answer.
  std::string reason;
  // More about it, for instance "job": the recalibration that runs.
  std::map<std::string, std::string> metadata;
  // When to try again; nothing where that is of no use.
  std::optional<Duration> retry_after;
  // Fields of the request that make no sense, each with what is wrong.
  std::vector<std::pair<std::string, std::string>> bad_fields;
  // What the error is about: `detail.thing()`, `got()`, `wanted()`, and why a page is lost.
  v1::ErrorDetail detail;
};

// What a client proves with who it is, and believes a service by: contents of PEM files.
struct Certificates {
  std::string ca;           // of the authorities that the service's certificate may come from
  std::string certificate;  // of the client
  std::string key;          // its private key
};

class Client {
 public:
  // `target` is HOST:PORT or unix:PATH. It connects at the first call, and again whenever the connection was lost.
  explicit Client(const std::string& target);

  // The same with TLS.
  Client(const std::string& target, const Certificates& certificates);

  // What the service is: camera, page, model, limits.
  v1::DescribeReply describe(Deadline deadline);

  // Decode a frame pair. `pixels` are the in-phase frame and, behind it, the quadrature frame: rows first, one byte a
  // pixel, or two, little-endian. They are sent in chunks of at most `chunk_bytes` (DescribeReply.limits; 0 for 1 MiB).
  // At a Unix socket, a header without a session gets that of this client: the service tells no connections apart there.
  v1::DecodeReply decode(const v1::DecodeHeader& header, const void* pixels, std::size_t bytes, Deadline deadline,
                         std::size_t chunk_bytes = 0);

  // Read a page of the service's own source. With a `request_id` at most one shot is taken: an answer that does not
  // come within `attempt`, or is lost with the connection, is asked for again. Without one, a lost answer is lost.
  v1::ReadPageReply read_page(const v1::ReadPageRequest& request, Deadline deadline,
                              Duration attempt = std::chrono::seconds(10));

  // Start a recalibration. ABORTED with reason "RECALIBRATION_RUNS": another one runs, metadata "job" names it.
  v1::Job start_recalibration(const v1::StartRecalibrationRequest& request, Deadline deadline);

  // Follow a job to its end and return it as it is then. `changed` is told how it is now, and at each change. A lost
  // connection is made again. DEADLINE_EXCEEDED: it still ran.
  v1::Job watch_job(const std::string& id, const std::function<void(const v1::Job&)>& changed, Deadline deadline);

  // Stop a job at its next step; returns it as it is now.
  v1::Job cancel_job(const std::string& id, Deadline deadline);

 private:
  std::unique_ptr<v1::Lightpage::Stub> stub_;
  std::string session_;  // its own at a Unix socket, else empty
};

}  // namespace lightpage
