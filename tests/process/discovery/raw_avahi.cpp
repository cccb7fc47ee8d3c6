// SPDX-License-Identifier: Apache-2.0
//
// Any other program that uses Avahi, without anything of ours.
//
//   raw-avahi publish NAME SUBTYPE PORT TXT...   announces a _dssm._tcp service, prints "published
//                                                NAME" (which may have been changed), stays
//   raw-avahi flood COUNT SUBTYPE                announces so many, prints "published"; stays
//   raw-avahi resolve NAME TYPE                  waits for it, prints "port N" and one "txt ..." a
//                                                string, in no certain order (libavahi-client);
//                                                ends
//   raw-avahi record DOMAIN_NAME TXT             waits for the TXT record of this PC's own, prints
//                                                its strings in the order of the wire; ends
//   raw-avahi rename NAME                        lets the Avahi daemon call this PC so; ends when
//                                                it has announced that
#include <avahi-client/client.h>
#include <avahi-client/lookup.h>
#include <avahi-client/publish.h>
#include <avahi-common/error.h>
#include <avahi-common/simple-watch.h>

#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <string>

namespace {

AvahiSimplePoll* simple_poll = nullptr;
const char* wanted = nullptr;
const char* wanted_name = nullptr;  // of this PC
int missing = 0;                    // groups that are not established

void on_client(AvahiClient* client, AvahiClientState state, void*) {
  if (state != AVAHI_CLIENT_S_RUNNING || !wanted_name) return;
  const char* const name = avahi_client_get_host_name(client);
  if (name && std::strcmp(name, wanted_name) == 0) avahi_simple_poll_quit(simple_poll);
}

void on_group(AvahiEntryGroup*, AvahiEntryGroupState state, void*) {
  if (state != AVAHI_ENTRY_GROUP_ESTABLISHED || --missing > 0) return;
  std::printf("published\n");
  std::fflush(stdout);
}

bool publish(AvahiClient* client, const std::string& name, const char* subtype, int port,
             AvahiStringList* txt) {
  AvahiEntryGroup* const group = avahi_entry_group_new(client, on_group, nullptr);
  return group &&
         avahi_entry_group_add_service_strlst(
             group, AVAHI_IF_UNSPEC, AVAHI_PROTO_UNSPEC, AvahiPublishFlags{}, name.c_str(),
             "_dssm._tcp", nullptr, nullptr, static_cast<std::uint16_t>(port), txt) == 0 &&
         avahi_entry_group_add_service_subtype(group, AVAHI_IF_UNSPEC, AVAHI_PROTO_UNSPEC,
                                               AvahiPublishFlags{}, name.c_str(), "_dssm._tcp",
                                               nullptr, subtype) == 0 &&
         avahi_entry_group_commit(group) == 0;
}

void on_resolved(AvahiServiceResolver* resolver, AvahiIfIndex, AvahiProtocol,
                 AvahiResolverEvent event, const char*, const char*, const char*, const char*,
                 const AvahiAddress*, std::uint16_t port, AvahiStringList* txt,
                 AvahiLookupResultFlags, void*) {
  if (event == AVAHI_RESOLVER_FOUND && wanted) {
    wanted = nullptr;
    std::printf("port %d\n", port);
    for (; txt; txt = avahi_string_list_get_next(txt)) {
      std::printf("txt %s\n", reinterpret_cast<const char*>(avahi_string_list_get_text(txt)));
    }
    avahi_simple_poll_quit(simple_poll);
  }
  avahi_service_resolver_free(resolver);
}

void on_browser(AvahiServiceBrowser* browser, AvahiIfIndex interface, AvahiProtocol protocol,
                AvahiBrowserEvent event, const char* name, const char* type, const char* domain,
                AvahiLookupResultFlags, void*) {
  if (event != AVAHI_BROWSER_NEW || !wanted || std::strcmp(name, wanted) != 0) return;
  avahi_service_resolver_new(avahi_service_browser_get_client(browser), interface, protocol, name,
                             type, domain, protocol, AvahiLookupFlags{}, on_resolved, nullptr);
}

void on_record(AvahiRecordBrowser*, AvahiIfIndex, AvahiProtocol, AvahiBrowserEvent event,
               const char*, std::uint16_t, std::uint16_t, const void* data, std::size_t size,
               AvahiLookupResultFlags, void*) {
  if (event != AVAHI_BROWSER_NEW || !wanted) return;
  wanted = nullptr;
  const std::string bytes(static_cast<const char*>(data), size);
  for (std::size_t at = 0; at < size; at += 1 + static_cast<unsigned char>(bytes[at])) {
    std::printf("txt %s\n", bytes.substr(at + 1, static_cast<unsigned char>(bytes[at])).c_str());
  }
  avahi_simple_poll_quit(simple_poll);
}

}  // namespace

int main(int argc, char** argv) {
  const std::string command = argc > 2 ? argv[1] : "";
  simple_poll = avahi_simple_poll_new();
  int error = 0;
  AvahiClient* const client = avahi_client_new(avahi_simple_poll_get(simple_poll),
                                               AvahiClientFlags{}, on_client, nullptr, &error);
  if (!client) {
    std::fprintf(stderr, "raw-avahi: %s\n", avahi_strerror(error));
    return 1;
  }
  bool good = false;
  if (command == "publish" && argc > 4) {
    AvahiStringList* txt = nullptr;
    for (int i = argc - 1; i > 4; --i) txt = avahi_string_list_add(txt, argv[i]);
    missing = 1;
    good = publish(client, argv[2], argv[3], std::atoi(argv[4]), txt);
    avahi_string_list_free(txt);
  } else if (command == "flood" && argc > 3) {
    missing = std::atoi(argv[2]);
    good = true;
    for (int i = missing; i > 0 && good; --i) {
      good = publish(client, "flood " + std::to_string(i), argv[3], 9, nullptr);
    }
  } else if (command == "resolve" && argc > 3) {
    wanted = argv[2];
    good = avahi_service_browser_new(client, AVAHI_IF_UNSPEC, AVAHI_PROTO_UNSPEC, argv[3], nullptr,
                                     AvahiLookupFlags{}, on_browser, nullptr);
  } else if (command == "rename") {
    wanted_name = argv[2];
    good = avahi_client_set_host_name(client, wanted_name) == 0;
  } else if (command == "record") {
    wanted = argv[2];
    good = avahi_record_browser_new(client, AVAHI_IF_UNSPEC, AVAHI_PROTO_UNSPEC, argv[2],
                                    AVAHI_DNS_CLASS_IN, AVAHI_DNS_TYPE_TXT, AvahiLookupFlags{},
                                    on_record, nullptr);
  }
  if (!good) {
    std::fprintf(stderr, "raw-avahi: %s\n", avahi_strerror(avahi_client_errno(client)));
    return 1;
  }
  avahi_simple_poll_loop(simple_poll);
  avahi_client_free(client);
  avahi_simple_poll_free(simple_poll);
  return 0;
}
