// SPDX-License-Identifier: Apache-2.0
//
// Another host for the fuzzer of the local protocol: it has every requested stream, and answers
// only when answer() is called.
#pragma once

#include <functional>
#include <utility>
#include <vector>

#include "daemon/local/local_requests.hpp"
#include "daemon/streams/registry.hpp"

namespace dssm::daemon {

class LateFleet final : public Fleet {
 public:
  // Sends all pending answers.
  void answer() {
    for (const std::function<void()>& due : std::exchange(due_, {})) due();
  }

  void observe(Observer* observer) override { observer_ = observer; }
  bool is_there(const StreamId& id) const override { return pc2_.knows(id); }

  void when_known(const StreamId&, std::size_t, std::function<void()> go_on) override { go_on(); }
  void open_reader(const StreamId& id, bool, const std::string&,
                   Then<std::shared_ptr<Stream>> then) override {
    due_.push_back([this, id, then = std::move(then)] { then(ring(id)); });
  }
  void want_history(const StreamId&) override {}
  void open_writer(const StreamId& id, const CreatePlan* plan, const std::string&,
                   Then<OpenedRing> then) override {
    if (plan) replace(id);
    due_.push_back([this, id, then = std::move(then)] {
      const Result<std::shared_ptr<Stream>> stream = ring(id);
      if (!stream) return then(stream.error());
      then(OpenedRing{*stream, false});
    });
  }
  Result<std::shared_ptr<Stream>> adopt_untrusted(const StreamId& id, Role, OfferedFiles files,
                                                  bool, const std::string&) override {
    return pc2_.adopt_untrusted(id, std::move(files));
  }
  void forward(const StreamId& id, const local::Request& request,
               Then<local::Response> then) override {
    if (request.has_remove()) replace(id);
    due_.push_back([this, id, body = request.body_case(), then = std::move(then)] {
      local::Response response;
      if (body == local::Request::kInfo) {
        const Result<std::shared_ptr<Stream>> stream = ring(id);
        if (!stream) return then(stream.error());
        wire::to_message((*stream)->info(), *response.mutable_stream_list()->add_streams());
      } else if (body == local::Request::kGetProperty) {
        response.mutable_property()->set_property("x");
      } else {
        response.mutable_done();
      }
      then(std::move(response));
    });
  }
  void list(Then<std::vector<proto::Stream>> then) override {
    due_.push_back([this, then = std::move(then)] {
      std::vector<proto::Stream> streams;
      for (const auto& stream : pc2_.streams()) {
        wire::to_message(stream->info(), streams.emplace_back());
      }
      then(std::move(streams));
    });
  }
  void list_clock_pairs(std::function<void(std::vector<ClockPair>)> then) override {
    due_.push_back([then = std::move(then)] { then({ClockPair()}); });
  }
  void list_nodes(NodeTable nodes, std::function<void(NodeTable)> then) override {
    due_.push_back([nodes = std::move(nodes), then = std::move(then)] { then(nodes); });
  }
  void follow_playback(const proto::FollowPlayback&, Then<proto::PlaybackFollowers> then) override {
    due_.push_back([then = std::move(then)] { then(proto::PlaybackFollowers()); });
  }
  const StreamInfo* next_stream(const StreamId& id) const override {
    const Stream* next = nullptr;
    const auto key = [](const StreamId& of) { return std::pair(of.name, of.id); };
    for (const auto& stream : pc2_.streams()) {
      const StreamId& there = stream->id();
      if (id.host == there.host && key(there) <= key(id)) continue;
      if (!next || key(there) < key(next->id())) next = stream.get();
    }
    if (!next) return nullptr;
    next_ = next->info();
    return &next_;
  }
  std::vector<local::Host> hosts() const override { return std::vector<local::Host>(2); }
  void describe(local::Daemon&) const override {}
  Result<UniqueFd> clock_page() const override { return Error{Errc::not_found, "no page here"}; }
  void ping(const std::string&, Then<local::RoundTrip> then) override {
    due_.push_back([then = std::move(then)] { then(local::RoundTrip()); });
  }

 private:
  // The ring of `id`, created at the first request.
  Result<std::shared_ptr<Stream>> ring(const StreamId& id) {
    auto created =
        pc2_.create({id.name, id.id, ""}, {"T", 8, 8, {}}, {4, std::chrono::milliseconds(1)}, 1);
    if (!created) return std::move(created).error();
    return created->stream;
  }
  // Removes the stream, recreates it with another ring, and notifies its readers.
  void replace(const StreamId& id) {
    const StreamId there{id.name, id.id, "pc2"};
    const Result<std::shared_ptr<Stream>> old = pc2_.find(there);
    if (!old || !pc2_.remove(there)) return;
    if (observer_) observer_->on_remote_stream_removed(there);
    if (const auto replaced = ring(id); replaced && observer_) {
      observer_->on_remote_stream_added((*replaced)->info());
    }
    if (observer_) observer_->on_ring_replaced(**old);
  }

  Registry pc2_{"pc2", {.max_streams = 8, .max_memory_bytes = 1 << 20, .max_property_bytes = 16}};
  mutable StreamInfo next_;  // what next_stream() returned
  Observer* observer_ = nullptr;
  std::vector<std::function<void()>> due_;
};

}  // namespace dssm::daemon
