#include "lightpage_client.h"

#include <algorithm>
#include <random>
#include <sstream>
#include <thread>

#include "error_details.pb.h"

namespace lightpage {
namespace {

using std::chrono::milliseconds;

constexpr int kReplyBytes = 64 << 20;  // the service's largest reply
constexpr std::size_t kChunkBytes = 1 << 20;
constexpr std::size_t kSocketBytes = 107;  // of a Unix socket's path, as the system has it
constexpr milliseconds kFirstPause{100}, kLongestPause{1000};  // between attempts where the service does not answer

std::shared_ptr<grpc::Channel> open_channel(const std::string& target,
                                            const std::shared_ptr<grpc::ChannelCredentials>& credentials) {
  if (target.rfind("unix:", 0) == 0 && target.size() - 5 > kSocketBytes) {
    throw Error(grpc::StatusCode::INVALID_ARGUMENT,
                target + ": got " + std::to_string(target.size() - 5) + " bytes, wanted a path of at most " +
                    std::to_string(kSocketBytes) + " bytes for a Unix socket",
                "", "");
  }
  grpc::ChannelArguments options;
  options.SetMaxReceiveMessageSize(kReplyBytes);
  options.SetInt(GRPC_ARG_ENABLE_HTTP_PROXY, 0);  // the device is on the local network
  // gRPC's own pauses grow to two minutes; a service that is back is to be found within about a second.
  options.SetInt(GRPC_ARG_INITIAL_RECONNECT_BACKOFF_MS, 100);
  options.SetInt(GRPC_ARG_MAX_RECONNECT_BACKOFF_MS, 1000);
  options.SetInt(GRPC_ARG_MIN_RECONNECT_BACKOFF_MS, 2000);  // an attempt to connect may take so long
  // A service that has gone without a word is noticed while a call waits for it.
  options.SetInt(GRPC_ARG_KEEPALIVE_TIME_MS, 30000);
  options.SetInt(GRPC_ARG_KEEPALIVE_TIMEOUT_MS, 20000);
  return grpc::CreateCustomChannel(target, credentials, options);
}

std::string trailer(const grpc::ClientContext& context, const char* key) {
  const auto& all = context.GetServerTrailingMetadata();
  const auto found = all.find(key);
  return found == all.end() ? std::string() : std::string(found->second.data(), found->second.size());
}

void check(const grpc::Status& status, const grpc::ClientContext& context) {
  if (!status.ok()) {
    throw Error(status.error_code(), status.error_message(), status.error_details(),
                trailer(context, "lightpage-error-bin"));
  }
}

// Whether a packed message is google.rpc's `name`; if so, `message` gets its fields.
template <typename Message>
bool unpack(const google::protobuf::Any& packed, const std::string& name, Message& message) {
  const std::string suffix = "/google.rpc." + name, &url = packed.type_url();
  return url.size() >= suffix.size() && url.compare(url.size() - suffix.size(), suffix.size(), suffix) == 0 &&
         message.ParseFromString(packed.value());
}

// Wait so long, or throw `error` where the deadline comes first.
void wait_or_throw(Duration pause, Deadline deadline, const Error& error) {
  if (Clock::now() + pause >= deadline) throw error;
  std::this_thread::sleep_for(pause);
}

// Call until it goes well. It is repeated after the time that the service names, and where `may_repeat` says so.
template <typename Call>
auto retried(Deadline deadline, const std::function<bool(const Error&)>& may_repeat, Call call) {
  Duration pause = kFirstPause;
  for (;;) {
    try {
      return call();
    } catch (const Error& error) {
      if (!error.retry_after && !may_repeat(error)) throw;
      wait_or_throw(error.retry_after.value_or(pause), deadline, error);
      pause = std::min<Duration>(2 * pause, kLongestPause);
    }
  }
}

bool never(const Error&) { return false; }

bool unavailable(const Error& error) { return error.code == grpc::StatusCode::UNAVAILABLE; }

// One call with one request and one reply.
template <typename Reply, typename Request>
Reply ask(v1::Lightpage::Stub& stub,
          grpc::Status (v1::Lightpage::Stub::*method)(grpc::ClientContext*, const Request&, Reply*),
          const Request& request, Deadline deadline) {
  grpc::ClientContext context;
  context.set_deadline(deadline);
  Reply reply;
  check((stub.*method)(&context, request, &reply), context);
  return reply;
}

// A name that no other client has, for one at a Unix socket; empty for others, whose connections have sessions.
std::string session_at(const std::string& target) {
  if (target.rfind("unix:", 0) != 0) return "";
  std::random_device random;
  std::ostringstream name;
  name << "client " << std::hex;
  for (int i = 0; i < 4; ++i) name << random() << '-';
  return name.str();
}

bool has_ended(const v1::Job& job) {
  return job.state() != v1::JOB_STATE_RUNNING && job.state() != v1::JOB_STATE_UNSPECIFIED;
}

}  // namespace

Deadline in(Duration seconds) { return Clock::now() + std::chrono::duration_cast<Clock::duration>(seconds); }

Error::Error(grpc::StatusCode status_code, const std::string& message, const std::string& details,
             const std::string& error)
    : std::runtime_error(message.empty() ? "gRPC status " + std::to_string(status_code) : message), code(status_code) {
  if (!detail.ParseFromString(error)) detail.Clear();
  client::Status status;
  if (!status.ParseFromString(details)) return;
  for (const auto& packed : status.details()) {
    client::ErrorInfo info;
    client::RetryInfo retry;
    client::BadRequest bad;
    if (unpack(packed, "ErrorInfo", info) && info.domain() == "lightpage") {
      reason = info.reason();
      metadata.insert(info.metadata().begin(), info.metadata().end());
    } else if (unpack(packed, "RetryInfo", retry)) {
      const auto& delay = retry.retry_delay();
      retry_after = Duration(static_cast<double>(delay.seconds()) + 1e-9 * delay.nanos());
    } else if (unpack(packed, "BadRequest", bad)) {
      for (const auto& field : bad.field_violations()) bad_fields.emplace_back(field.field(), field.description());
    }
  }
}

Client::Client(const std::string& target)
    : stub_(v1::Lightpage::NewStub(open_channel(target, grpc::InsecureChannelCredentials()))),
      session_(session_at(target)) {}

Client::Client(const std::string& target, const Certificates& own)
    : stub_(v1::Lightpage::NewStub(
          open_channel(target, grpc::SslCredentials({own.ca, own.key, own.certificate})))),
      session_(session_at(target)) {}

v1::DescribeReply Client::describe(Deadline deadline) {
  return retried(deadline, unavailable, [&] {
    return ask(*stub_, &v1::Lightpage::Stub::Describe, v1::DescribeRequest(), deadline);
  });
}

v1::DecodeReply Client::decode(const v1::DecodeHeader& header, const void* pixels, std::size_t bytes,
                               Deadline deadline, std::size_t chunk_bytes) {
  const char* const data = static_cast<const char*>(pixels);
  const std::size_t step = chunk_bytes == 0 ? kChunkBytes : chunk_bytes;
  return retried(deadline, unavailable, [&] {
    grpc::ClientContext context;
    context.set_deadline(deadline);
    v1::DecodeReply reply;
    const auto writer = stub_->DecodeFrames(&context, &reply);
    v1::DecodeFramesRequest part;
    *part.mutable_header() = header;
    v1::DecodeOptions& options = *part.mutable_header()->mutable_options();
    if (options.session().empty() && options.tracking() != v1::TRACKING_STATELESS) options.set_session(session_);
    bool sent = writer->Write(part);
    for (std::size_t start = 0; sent && start < bytes; start += step) {
      part.set_chunk(data + start, std::min(step, bytes - start));
      sent = writer->Write(part);  // false where the service has answered already: the status says what
    }
    writer->WritesDone();
    check(writer->Finish(), context);
    return reply;
  });
}

v1::ReadPageReply Client::read_page(const v1::ReadPageRequest& request, Deadline deadline, Duration attempt) {
  const bool by_id = !request.request_id().empty();
  const auto lost = [&](const Error& error) {
    return by_id && (unavailable(error) || error.code == grpc::StatusCode::DEADLINE_EXCEEDED);
  };
  return retried(deadline, lost, [&] {
    return ask(*stub_, &v1::Lightpage::Stub::ReadPage, request, by_id ? std::min(deadline, in(attempt)) : deadline);
  });
}

v1::Job Client::start_recalibration(const v1::StartRecalibrationRequest& request, Deadline deadline) {
  // Not repeated where the connection is lost: the job may have begun. ListJobs says so.
  return retried(deadline, never, [&] {
    return ask(*stub_, &v1::Lightpage::Stub::StartRecalibration, request, deadline);
  });
}

v1::Job Client::watch_job(const std::string& id, const std::function<void(const v1::Job&)>& changed,
                          Deadline deadline) {
  // CANCELLED: a service that is being stopped ends its long calls.
  const auto lost = [](const Error& error) {
    return unavailable(error) || error.code == grpc::StatusCode::CANCELLED;
  };
  v1::WatchJobRequest request;
  request.set_id(id);
  return retried(deadline, lost, [&] {
    grpc::ClientContext context;
    context.set_deadline(deadline);
    const auto reader = stub_->WatchJob(&context, request);
    v1::Job job;
    while (reader->Read(&job)) changed(job);
    check(reader->Finish(), context);
    if (!has_ended(job)) throw Error(grpc::StatusCode::UNAVAILABLE, "the watch ended before the job", "", "");
    return job;
  });
}

v1::Job Client::cancel_job(const std::string& id, Deadline deadline) {
  v1::CancelJobRequest request;
  request.set_id(id);
  return retried(deadline, unavailable, [&] {
    return ask(*stub_, &v1::Lightpage::Stub::CancelJob, request, deadline);
  });
}

}  // namespace lightpage
