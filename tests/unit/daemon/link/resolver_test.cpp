// SPDX-License-Identifier: Apache-2.0
//
// Looking names up beside the loop, with a look-up of the test's own.
#include "daemon/link/resolver.hpp"

#include <gtest/gtest.h>

#include <atomic>
#include <semaphore>

#include "tests/unit/daemon/run_loop.hpp"

namespace dssm::daemon {
namespace {

using Addresses = std::vector<wire::SocketAddress>;

Addresses number(const std::string& text) {
  return wire::resolve_number(wire::Address::parse(text).value());
}

TEST(Resolver, AnswersNumbersWithoutALookup) {
  EventLoop loop = EventLoop::open().value();
  std::atomic<int> lookups = 0;
  Resolver resolver(loop, [&](const wire::Address&) -> Result<Addresses> {
    ++lookups;
    return Addresses{};
  });
  std::optional<Result<Addresses>> answer;
  const auto ticket = resolver.resolve({"127.0.0.1", 5}, [&](auto found) { answer = found; });
  EXPECT_FALSE(answer) << "from the loop, not from within the call";
  run_until(loop, [&] { return answer.has_value(); });
  ASSERT_TRUE(*answer);
  EXPECT_EQ((**answer).at(0).str(), "127.0.0.1:5");
  EXPECT_EQ(lookups, 0);
}

TEST(Resolver, KeepsTheLoopRunningDuringALookup) {
  EventLoop loop = EventLoop::open().value();
  std::binary_semaphore go_on(0);
  Resolver resolver(loop, [&](const wire::Address& address) -> Result<Addresses> {
    if (address.host == "slow") go_on.acquire();
    if (address.host == "none") return Error{Errc::not_found, "no such host"};
    return number("10.0.0.2:" + std::to_string(address.port));
  });
  std::optional<Result<Addresses>> slow, number_answer, none;
  const auto one = resolver.resolve({"slow", 1}, [&](auto found) { slow = found; });
  const auto two = resolver.resolve({"127.0.0.1", 2}, [&](auto found) { number_answer = found; });
  const auto three = resolver.resolve({"none", 3}, [&](auto found) { none = found; });
  run_until(loop, [&] { return number_answer.has_value(); });
  EXPECT_FALSE(slow);
  go_on.release();
  run_until(loop, [&] { return none.has_value(); });
  ASSERT_TRUE(slow && *slow);
  EXPECT_EQ((**slow).at(0).str(), "10.0.0.2:1");
  ASSERT_FALSE(*none);
  EXPECT_EQ(none->error().code, Errc::not_found);
}

TEST(Resolver, ResolvesANameOnceForAllRequests) {
  EventLoop loop = EventLoop::open().value();
  std::counting_semaphore<> go_on(0);
  std::atomic<int> lookups = 0;
  Resolver resolver(loop, [&](const wire::Address& address) -> Result<Addresses> {
    ++lookups;
    go_on.acquire();
    return number("10.0.0.2:" + std::to_string(address.port));
  });
  int answers = 0;
  std::vector<Resolver::Ticket> tickets;
  for (int i = 0; i < 10; ++i) {
    tickets.push_back(resolver.resolve({"pc2", 1}, [&](auto found) {
      ASSERT_TRUE(found);
      ++answers;
    }));
  }
  go_on.release(10);
  run_until(loop, [&] { return answers == 10; });
  EXPECT_EQ(lookups, 1);
}

TEST(Resolver, DoesNotCallBackADestroyedTicket) {
  EventLoop loop = EventLoop::open().value();
  std::atomic<int> lookups = 0;
  std::counting_semaphore<> go_on(0);
  Resolver resolver(loop, [&](const wire::Address&) -> Result<Addresses> {
    ++lookups;
    go_on.acquire();
    return number("10.0.0.2:1");
  });
  bool first = false, last = false;
  auto ticket = resolver.resolve({"a", 1}, [&](auto) { first = true; });
  while (lookups == 0) std::this_thread::yield();
  auto never = resolver.resolve({"b", 1}, [&](auto) { FAIL(); });
  const auto kept = resolver.resolve({"c", 1}, [&](auto) { last = true; });
  ticket.reset();
  never.reset();
  go_on.release(3);
  run_until(loop, [&] { return last; });
  EXPECT_FALSE(first);
  EXPECT_EQ(lookups, 2) << "nobody wants to know 'b'";
}

TEST(Resolver, TakesNoAddressesForAFailure) {
  EventLoop loop = EventLoop::open().value();
  Resolver resolver(loop, [](const wire::Address&) -> Result<Addresses> { return Addresses{}; });
  std::optional<Result<Addresses>> answer;
  const auto ticket = resolver.resolve({"pc2", 1}, [&](auto found) { answer = found; });
  run_until(loop, [&] { return answer.has_value(); });
  ASSERT_FALSE(*answer);
  EXPECT_EQ(answer->error().code, Errc::not_found);
}

TEST(Resolver, MayBeDestroyedWhileItsThreadIsBusy) {
  EventLoop loop = EventLoop::open().value();
  static std::binary_semaphore busy(0), go_on(0);  // outlive the test: the thread does
  {
    Resolver resolver(loop, [](const wire::Address&) -> Result<Addresses> {
      busy.release();
      go_on.acquire();
      return number("10.0.0.2:1");
    });
    const auto ticket = resolver.resolve({"pc2", 1}, [](auto) { FAIL(); });
    busy.acquire();
  }
  go_on.release();
}

}  // namespace
}  // namespace dssm::daemon
