// SPDX-License-Identifier: Apache-2.0
#include "daemon/streams/stream.hpp"

#include <fcntl.h>
#include <fmt/format.h>
#include <sys/eventfd.h>
#include <sys/random.h>
#include <unistd.h>

#include <algorithm>
#include <cerrno>

#include "core/base/quiet_thread.hpp"
#include "core/base/sealed_memory.hpp"
#include "core/base/try.hpp"
#include "core/ring/activity.hpp"
#include "core/ring/bell.hpp"
#include "core/ring/ring_reader.hpp"
#include "core/wire/local_protocol.hpp"
#include "daemon/streams/memory_files.hpp"

namespace dssm::daemon {
namespace {

Result<std::uint64_t> new_incarnation() {
  std::uint64_t value = 0;
  if (::getrandom(&value, sizeof value, 0) != sizeof value) return os_error("get a random number");
  return value;
}

Result<UniqueFd> create_doorbell() {
  UniqueFd fd(::eventfd(0, EFD_NONBLOCK | EFD_CLOEXEC));
  if (!fd) return os_error("create a doorbell");
  return fd;
}

static_assert(static_cast<int>(Purpose::own) == local::StreamMeta::OWN &&
              static_cast<int>(Purpose::mirror) == local::StreamMeta::MIRROR &&
              static_cast<int>(Purpose::remote_writer) == local::StreamMeta::REMOTE_WRITER);

local::StreamMeta meta_of(const Stream::Plan& plan) {
  local::StreamMeta meta;
  wire::to_message(plan.id, *meta.mutable_id());
  wire::to_message(plan.type, *meta.mutable_type());
  meta.set_creator_pid(plan.creator_pid);
  meta.set_account(plan.account);
  meta.set_created_order(plan.created_order);
  meta.set_purpose(static_cast<local::StreamMeta::Purpose>(plan.purpose));
  return meta;
}

// Takes the memory of a type's description from the budget.
Result<MemoryShare> take_type_share(MemoryBudget& budget, const TypeInfo& type) {
  proto::Type message;
  wire::to_message(type, message);
  const std::size_t type_bytes = message.ByteSizeLong();
  if (type_bytes > kMaxTypeBytes) {
    return Error{Errc::limit_exceeded, fmt::format("the description of its type takes {} bytes; at "
                                                   "most {} are taken: describe fewer fields",
                                                   type_bytes, kMaxTypeBytes)};
  }
  return budget.take(type_bytes);
}

// The plan that `meta` and the ring agree on.
Result<Stream::Plan> plan_untrusted(const local::StreamMeta& meta,
                                    const ring::RingMapping& mapping) {
  const StreamId id = DSSM_TRY(wire::stream_id_untrusted(meta.id()));
  const TypeInfo type = DSSM_TRY(wire::type_untrusted(meta.type()));
  const ring::RingIdentity& ring = mapping.identity();
  if (id != ring.id || type.payload_bytes != mapping.geometry().payload_bytes) {
    return Error{Errc::protocol, fmt::format("the offered meta file describes '{}' with {}, the "
                                             "offered ring is that of '{}' with {} bytes",
                                             id.str(), type.str(), ring.id.str(),
                                             mapping.geometry().payload_bytes)};
  }
  if (!local::StreamMeta::Purpose_IsValid(meta.purpose())) {
    return Error{Errc::protocol, "the offered ring of '" + id.str() +
                                     "' has a purpose that this dssmd does not know; install the "
                                     "newer version of DSSM again"};
  }
  return Stream::Plan{id,
                      type,
                      mapping.geometry().depth,
                      ring.cycle,
                      meta.creator_pid(),
                      wire::text_untrusted(meta.account(), wire::kMaxSentenceBytes),
                      meta.created_order(),
                      static_cast<Purpose>(meta.purpose()),
                      ring.incarnation};
}

// A program that may write to a ring can change what its header says, and offer the bell or the
// meta file of another stream with it.
Result<void> check_label_untrusted(const OfferedFiles& files, const std::string& label) {
  if (memory_file_name(files.ring.get()) == "dssm-ring:" + label &&
      memory_file_name(files.bell.get()) == "dssm-bell:" + label &&
      memory_file_name(files.meta.get()) == "dssm-meta:" + label) {
    return {};
  }
  return Error{Errc::protocol,
               fmt::format("the offered ring, bell and meta file are not those of '{}'", label)};
}

}  // namespace

Result<std::shared_ptr<Stream>> Stream::create(const Plan& plan, MemoryBudgets& budgets) {
  const ring::Geometry geometry = DSSM_TRY(ring::Geometry::of(plan.type.payload_bytes, plan.depth));
  MemoryBudget& budget = budgets.of(plan.account);
  MemoryShare type_share = DSSM_TRY(take_type_share(budget, plan.type));
  MemoryShare ring_share = DSSM_TRY(budget.take(geometry.total_bytes));
  const std::uint64_t incarnation =
      DSSM_TRY(plan.incarnation != 0 ? Result(plan.incarnation) : new_incarnation());
  const ring::RingIdentity identity{plan.id, incarnation, plan.cycle, plan.type.alignment_bytes};
  UniqueFd ring = DSSM_TRY(ring::create_ring(identity, geometry));
  UniqueFd bell = DSSM_TRY(ring::create_bell(identity.label()));
  MetaFile meta = DSSM_TRY(MetaFile::create(meta_of(plan), identity.label()));
  auto mapping = DSSM_TRY(ring::RingMapping::open_untrusted(ring.get(), ring::Access::read_only));
  return std::shared_ptr<Stream>(new Stream(plan, Files{std::move(ring), std::move(bell)},
                                            std::move(meta), std::move(mapping),
                                            std::move(ring_share), std::move(type_share)));
}

Result<std::shared_ptr<Stream>> Stream::adopt_untrusted(OfferedFiles files,
                                                        MemoryBudgets& budgets) {
  DSSM_TRY(check_own_memory_file(files.ring.get(), kSizeSeals, "ring"));
  DSSM_TRY(check_own_memory_file(files.bell.get(), kSizeSeals, "bell"));
  auto mapping =
      DSSM_TRY(ring::RingMapping::open_untrusted(files.ring.get(), ring::Access::read_only));
  DSSM_TRY(ring::Bell::open_untrusted(files.bell.get()));
  DSSM_TRY(check_label_untrusted(files, mapping->identity().label()));
  MetaFile meta = DSSM_TRY(MetaFile::open_untrusted(std::move(files.meta)));
  const local::StreamMeta content = DSSM_TRY(meta.read_untrusted());
  Plan plan = DSSM_TRY(plan_untrusted(content, *mapping));
  MemoryBudget& budget = budgets.of(plan.account);
  MemoryShare type_share = DSSM_TRY(take_type_share(budget, plan.type));
  MemoryShare ring_share = DSSM_TRY(budget.take(mapping->geometry().total_bytes));
  MemoryShare property_share = DSSM_TRY(budget.take(content.property().size()));
  // Always a new one: writers get a descriptor that does not depend on the client's.
  UniqueFd ring = DSSM_TRY(reopen_read_write(files.ring.get()));
  std::shared_ptr<Stream> stream(
      new Stream(std::move(plan), Files{std::move(ring), std::move(files.bell)}, std::move(meta),
                 std::move(mapping), std::move(ring_share), std::move(type_share)));
  stream->property_share_ = std::move(property_share);
  stream->take_doorbell_untrusted(files.client, std::move(files.doorbell));
  return stream;
}

// Freeing gigabytes takes most of a second, which the loop must not wait for.
Stream::~Stream() {
  if (mapping_->geometry().total_bytes < kFreedElsewhereBytes) return;
  Result<std::thread> thread = quiet_thread(
      "free a ring", [ring = std::move(files_.ring), mapping = std::move(mapping_)]() mutable {
        mapping.reset();
        ring.reset();
      });
  if (thread) thread->detach();
}

Result<void> Stream::describe_as(const TypeInfo& type, MemoryBudget& budget) {
  MemoryShare share = DSSM_TRY(take_type_share(budget, type));
  local::StreamMeta content = DSSM_TRY(meta_.read_untrusted());
  wire::to_message(type, *content.mutable_type());
  DSSM_TRY(meta_.replace(content));
  plan_.type = type;
  type_share_ = std::move(share);
  return {};
}

StreamInfo Stream::info(bool with_fields, Time now) const {
  StreamInfo info;
  info.id = plan_.id;
  if (with_fields) {
    info.type = plan_.type;
  } else {
    info.type = {plan_.type.name, plan_.type.payload_bytes, plan_.type.alignment_bytes, {}};
  }
  info.depth = plan_.depth;
  info.cycle = plan_.cycle;
  info.memory_bytes = mapping_->geometry().total_bytes;
  info.property_bytes = property_share_.bytes();
  info.incarnation = mapping_->identity().incarnation;
  info.creator_pid = plan_.creator_pid;
  info.channels = static_cast<std::uint32_t>(channels_.size());
  info.crashed_writers = crashed_writers_.programs;
  info.last_crashed_writer = crashed_writers_.last;
  info.crashed_readers = crashed_readers_.programs;
  info.last_crashed_reader = crashed_readers_.last;
  for (const Channel& channel : channels_) {
    info.remote_writers += channel.writers;
    info.remote_readers += channel.readers;
  }
  info.writers = info.remote_writers;
  info.readers = info.remote_readers;
  ring::describe_activity(ring::RingReader(*mapping_), now, info);
  // Only an owner knows whether it can still be written to, and whether its newest sample is here.
  if (plan_.purpose != Purpose::own) info.state = StreamState::unknown;
  return info;
}

Result<std::vector<UniqueFd>> Stream::descriptors_for(Role role, ClientNumber client) {
  const bool writes = role == Role::writer;
  const int ring = files_.ring.get();
  std::vector<UniqueFd> descriptors;
  descriptors.push_back(DSSM_TRY(writes ? duplicate(ring) : reopen_read_only(ring)));
  descriptors.push_back(DSSM_TRY(duplicate(files_.bell.get())));
  descriptors.push_back(DSSM_TRY(reopen_read_only(meta_.fd())));
  if (!writes) return descriptors;
  const auto doorbell = doorbell_of(client);
  if (doorbell != doorbells_.end()) {
    descriptors.push_back(DSSM_TRY(duplicate(doorbell->fd.get())));
    return descriptors;
  }
  UniqueFd made = DSSM_TRY(create_doorbell());
  descriptors.push_back(DSSM_TRY(duplicate(made.get())));
  add_doorbell(client, std::move(made));
  return descriptors;
}

std::vector<int> Stream::descriptors_to_keep() const {
  return {files_.ring.get(), files_.bell.get(), meta_.fd()};
}

Result<std::shared_ptr<const ring::RingMapping>> Stream::map_for_writing() const {
  auto ring =
      DSSM_TRY(ring::RingMapping::open_untrusted(files_.ring.get(), ring::Access::read_write),
               "stream '" + plan_.id.str() + "'");
  if (ring->geometry() == mapping_->geometry()) return ring;
  return Error{Errc::protocol,
               fmt::format("stream '{}': a program has overwritten what the ring's header says "
                           "about its size; `dssmctl rm` the stream, and let its writer create it "
                           "again",
                           plan_.id.str())};
}

Result<std::shared_ptr<ring::Bell>> Stream::map_bell() const {
  return ring::Bell::open_untrusted(files_.bell.get());
}

Result<void> Stream::reserve(std::uint64_t offset, std::uint64_t bytes) {
  int failed = 0;
  do {
    failed =
        ::posix_fallocate(files_.ring.get(), static_cast<off_t>(offset), static_cast<off_t>(bytes));
  } while (failed == EINTR);
  if (!failed) return {};
  return os_error(
      fmt::format("reserve {} bytes of memory for the ring of '{}'", bytes, plan_.id.str()),
      failed);
}

bool Stream::is_ring(int fd) const noexcept { return same_file(fd, files_.ring.get()); }

void Stream::take_doorbell_untrusted(ClientNumber client, UniqueFd doorbell) {
  if (!doorbell || kind_of_untrusted(doorbell.get()) != DescriptorKind::doorbell) return;
  remove_doorbell(client);
  add_doorbell(client, std::move(doorbell));
}

void Stream::remove_doorbell(ClientNumber client) {
  const auto doorbell = doorbell_of(client);
  if (doorbell == doorbells_.end()) return;
  if (doorbell_observer_) doorbell_observer_->on_doorbell_removed(doorbell->fd.get());
  doorbells_.erase(doorbell);
}

std::vector<Stream::Doorbell>::iterator Stream::doorbell_of(ClientNumber client) {
  return std::find_if(doorbells_.begin(), doorbells_.end(),
                      [&](const Doorbell& one) { return one.client == client; });
}

void Stream::add_doorbell(ClientNumber client, UniqueFd doorbell) {
  doorbells_.push_back({client, std::move(doorbell)});
  if (doorbell_observer_) doorbell_observer_->on_doorbell_added(doorbells_.back().fd.get());
}

void Stream::observe_doorbells(DoorbellObserver* observer) {
  doorbell_observer_ = observer;
  if (!observer) return;
  for (const Doorbell& doorbell : doorbells_) observer->on_doorbell_added(doorbell.fd.get());
}

void Stream::set_channel(Channel channel) {
  const auto known = std::find_if(channels_.begin(), channels_.end(),
                                  [&](const Channel& one) { return one.key == channel.key; });
  if (known == channels_.end()) {
    channels_.push_back(std::move(channel));
  } else {
    *known = std::move(channel);
  }
}

void Stream::remove_channel(const void* key) {
  std::erase_if(channels_, [&](const Channel& one) { return one.key == key; });
}

Result<void> Stream::mark_removed() {
  DSSM_TRY(meta_.mark_removed());
  removed_ = true;
  return {};
}

Result<std::string> Stream::property() const {
  // Kept only in the meta file: dssmd's own memory stays small.
  local::StreamMeta content = DSSM_TRY(meta_.read_untrusted());
  return std::move(*content.mutable_property());
}

Result<void> Stream::set_property(const std::string& property, MemoryBudget& budget) {
  // Old and new one exist side by side for a moment, so the new share is taken first.
  MemoryShare share = DSSM_TRY(budget.take(property.size()));
  local::StreamMeta content = meta_of(plan_);
  content.set_property(property);
  DSSM_TRY(meta_.replace(content));
  property_share_ = std::move(share);
  return {};
}

}  // namespace dssm::daemon
