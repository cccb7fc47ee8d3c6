// SPDX-License-Identifier: Apache-2.0
//
// OpenSSL works on memory: its output is collected and sent by this file, its input comes straight
// from the lower transport into its buffer. OpenSSL's own way to send wants the same bytes again
// after each send that the socket did not take at once, and these may have changed in the ring
// meanwhile.
#include "core/wire/tls.hpp"

#include <fmt/format.h>
#include <openssl/err.h>
#include <openssl/ssl.h>
#include <poll.h>

#include <algorithm>
#include <array>
#include <cerrno>
#include <cstring>
#include <memory>
#include <new>
#include <optional>
#include <utility>
#include <vector>

#include "core/base/try.hpp"

namespace dssm::wire {
namespace {

constexpr std::size_t kRecordBytes = 16U << 10;  // of one TLS record, at most
// What is encrypted before it is sent: several records in one system call. When the network is to
// hold little that was not sent (limit_unsent()), one.
constexpr std::size_t kBatchBytes = 4 * kRecordBytes;

// A key of AES-GCM is good for 2^24.5 full records (RFC 8446, 5.5).
constexpr std::uint64_t kRecordsPerKey = 1U << 23;
// Records decrypted by one receive(): 1 MiB, or the turns of others would wait for one that sends
// its bytes one by one.
constexpr int kMaxReads = 64;
// Messages of TLS itself: a handshake has six, and a change of keys, which takes as long as some
// KiB of data, comes after much more data than this.
constexpr std::uint64_t kMaxMessages = 32, kDataBytesPerMessage = 1U << 20;

// The buffer for encrypted output, of the thread, so that connections with nothing to send have
// none.
std::vector<std::byte>& spare_output() {
  thread_local std::vector<std::byte> spare;
  return spare;
}

}  // namespace

class TlsTransport final : public Transport {
 public:
  TlsTransport(std::shared_ptr<const TlsCredentials> credentials, std::unique_ptr<Transport> lower,
               TransportEnd end, TlsTicket* ticket)
      : credentials_(std::move(credentials)),
        lower_(std::move(lower)),
        ticket_(ticket),
        session_(SSL_new(credentials_->context_)) {
    if (!session_) throw std::bad_alloc();
    BIO* bio = BIO_new(method());
    if (!bio) {
      SSL_free(session_);
      throw std::bad_alloc();
    }
    BIO_set_data(bio, this);
    BIO_set_init(bio, 1);
    SSL_set_bio(session_, bio, bio);
    SSL_set_app_data(session_, this);
    SSL_set_msg_callback(session_, on_message);
    SSL_set_msg_callback_arg(session_, this);
    SSL_set_verify(session_, SSL_VERIFY_PEER | SSL_VERIFY_FAIL_IF_NO_PEER_CERT, on_verified);
    if (end == TransportEnd::accepted) {
      SSL_set_accept_state(session_);
    } else {
      SSL_set_connect_state(session_);
      if (is_ticket_good()) SSL_set_session(session_, ticket_->session_);
    }
  }

  // Without TLS's closing message: a child of fork() must not send it for its parent.
  ~TlsTransport() override {
    if (ticket_ && peer_) keep_ticket();
    SSL_free(session_);
  }

  Result<bool> go_on() {
    ERR_clear_error();
    is_input_taken_ = false;
    const int done = SSL_do_handshake(session_);
    const std::optional<Error> failed = done == 1 ? std::nullopt : failure(done);
    // Also what tells the other side why it is refused.
    const Result<IoStatus> flushed = flush();
    if (failed) return *failed;
    if (!flushed) return flushed.error();
    if (done != 1) return end_ ? Result<bool>(closed()) : false;
    if (!peer_) {
      const bool is_known = ticket_ && SSL_session_reused(session_);
      peer_ = is_known ? *ticket_->peer_ : DSSM_TRY(certified_peer(session_));
    }
    has_more_input_ = true;  // maybe: OpenSSL receives what comes behind the handshake with it
    return output_.empty();
  }

  short events() const noexcept {
    return static_cast<short>(output_.empty() ? POLLIN : POLLIN | POLLOUT);
  }

  [[gnu::hot]] Result<IoResult> send(std::span<const iovec> parts) override {
    std::size_t left = 0, sent = 0;
    for (const iovec& part : parts) left += part.iov_len;
    std::size_t in_part = 0;
    for (auto part = parts.begin(); left > 0;) {
      const IoStatus flushed = DSSM_TRY(flush());
      if (flushed == IoStatus::end) return IoResult{IoStatus::end, 0};
      if (flushed == IoStatus::would_block) break;
      for (std::size_t batch = 0; batch < batch_bytes_ && left > 0;) {
        const std::span<const std::byte> record = next_record(part, in_part, left);
        DSSM_TRY(encrypt(record));
        batch += record.size();
        sent += record.size();
        left -= record.size();
      }
    }
    if (sent == 0) return IoResult{IoStatus::would_block, 0};
    const IoStatus flushed = DSSM_TRY(flush());
    return IoResult{flushed == IoStatus::end ? IoStatus::end : IoStatus::ok, sent};
  }

  [[gnu::hot]] Result<IoResult> receive(std::span<const iovec> spaces) override {
    if (ended_with_) return *ended_with_;
    ERR_clear_error();
    is_input_taken_ = false;
    std::size_t received = 0;
    int reads = 0;
    for (const iovec& space : spaces) {
      for (std::size_t filled = 0; filled < space.iov_len;) {
        std::size_t count = 0;
        const int done = SSL_read_ex(session_, static_cast<std::byte*>(space.iov_base) + filled,
                                     space.iov_len - filled, &count);
        if (done != 1) return stopped(done, received);
        filled += count;
        received += count;
        data_bytes_ += count;
        if (++reads == kMaxReads) {
          has_more_input_ = true;
          return IoResult{IoStatus::ok, received};
        }
      }
    }
    has_more_input_ = true;
    return IoResult{IoStatus::ok, received};
  }

  Result<IoResult> receive_waiting(std::span<const iovec> spaces) override {
    if (has_more_input_) return receive(spaces);
    pollfd ready{fd(), POLLIN, 0};
    if (::poll(&ready, 1, static_cast<int>(kReceiveWait.count())) < 0 && errno == EINTR) {
      return IoResult{IoStatus::interrupted, 0};
    }
    return receive(spaces);
  }

  bool has_buffered_input() const noexcept override { return has_more_input_; }
  bool has_unsent_output() const noexcept override { return !output_.empty(); }

  [[gnu::hot]] Result<IoStatus> flush() override {
    while (!output_.empty()) {
      const iovec rest{output_.data() + output_sent_, output_.size() - output_sent_};
      const Result<IoResult> sent = lower_->send({&rest, 1});
      if (!sent) return sent.error();
      if (sent->status != IoStatus::ok) return sent->status;
      output_sent_ += sent->bytes;
      if (output_sent_ < output_.size()) continue;
      output_.clear();
      output_sent_ = 0;
      spare_output().swap(output_);
      output_ = {};
    }
    return IoStatus::ok;
  }

  void stamp_arrivals() noexcept override { lower_->stamp_arrivals(); }
  std::optional<Time> arrived() const noexcept override { return lower_->arrived(); }
  void limit_unsent(std::size_t bytes) noexcept override {
    lower_->limit_unsent(bytes);
    batch_bytes_ = bytes > 0 ? kRecordBytes : kBatchBytes;
  }
  void set_priority(Priority priority) noexcept override { lower_->set_priority(priority); }
  std::optional<Progress> progress() const noexcept override {
    std::optional<Progress> progress = lower_->progress();
    if (progress) {
      const std::size_t here = output_.size() - output_sent_;
      progress->waiting_bytes += here;
      progress->unsent_bytes += here;
    }
    return progress;
  }
  const CertifiedPeer* peer() const noexcept override { return peer_ ? &*peer_ : nullptr; }
  int fd() const noexcept override { return lower_->fd(); }

 private:
  // OpenSSL itself does not check certificates again. Otherwise a full handshake reports why they
  // are refused.
  bool is_ticket_good() const {
    return ticket_ && ticket_->session_ && ticket_->credentials_.lock() == credentials_ &&
           credentials_->check(*ticket_->peer_);
  }

  // The ticket may have come at any time, so it is taken at the end.
  void keep_ticket() {
    SSL_set_shutdown(session_, SSL_SENT_SHUTDOWN);  // or SSL_free() makes the session unusable
    SSL_SESSION* const session = SSL_get1_session(session_);
    if (!session || !SSL_SESSION_is_resumable(session)) return SSL_SESSION_free(session);
    SSL_SESSION_free(std::exchange(ticket_->session_, session));
    ticket_->credentials_ = credentials_;
    ticket_->peer_ = peer_;
  }

  // The next bytes for one record: from the caller's memory, or, when they are in several parts,
  // collected.
  std::span<const std::byte> next_record(std::span<const iovec>::iterator& part,
                                         std::size_t& in_part, std::size_t left) {
    while (in_part == part->iov_len) ++part, in_part = 0;
    const std::size_t want = std::min(left, kRecordBytes);
    const auto rest = [&] {
      return std::span(static_cast<const std::byte*>(part->iov_base) + in_part,
                       part->iov_len - in_part);
    };
    if (rest().size() >= want) {
      const std::span<const std::byte> record = rest().first(want);
      in_part += want;
      return record;
    }
    using Record = std::array<std::byte, kRecordBytes>;
    thread_local const auto collected = std::make_unique<Record>();
    for (std::size_t bytes = 0; bytes < want;) {
      while (in_part == part->iov_len) ++part, in_part = 0;
      const std::size_t step = std::min(rest().size(), want - bytes);
      std::memcpy(collected->data() + bytes, rest().data(), step);
      bytes += step;
      in_part += step;
    }
    return std::span(*collected).first(want);
  }

  Result<void> encrypt(std::span<const std::byte> record) {
    ERR_clear_error();
    if (++records_ % kRecordsPerKey == 0) SSL_key_update(session_, SSL_KEY_UPDATE_NOT_REQUESTED);
    std::size_t written = 0;
    const int done = SSL_write_ex(session_, record.data(), record.size(), &written);
    if (done == 1) return {};
    if (std::optional<Error> failed = failure(done)) return *std::move(failed);
    return Error{Errc::unavailable, "encrypt for the other side: OpenSSL does not continue"};
  }

  // What receive() returns when SSL_read_ex() gave no bytes.
  Result<IoResult> stopped(int done, std::size_t received) {
    has_more_input_ = false;
    const int reason = SSL_get_error(session_, done);
    const std::optional<Error> failed = failure(done);
    // A change of keys, or what tells the other side what was wrong.
    const Result<IoStatus> flushed = flush();
    if (received > 0) {
      // What ended it is reported by the next call.
      ended_with_ = failed;
      has_more_input_ = failed || reason == SSL_ERROR_ZERO_RETURN || end_;
      return IoResult{IoStatus::ok, received};
    }
    if (failed) return *failed;
    if (!flushed) return flushed.error();
    if (end_ || reason == SSL_ERROR_ZERO_RETURN) return IoResult{IoStatus::end, 0};
    return IoResult{IoStatus::would_block, 0};
  }

  // Why OpenSSL does not go on; nothing when it waits for the network, or when the connection
  // ended.
  std::optional<Error> failure(int done) {
    const int kind = SSL_get_error(session_, done);
    if (lower_error_) return lower_error_;
    if (kind == SSL_ERROR_WANT_READ || kind == SSL_ERROR_ZERO_RETURN) return std::nullopt;
    if (!refusal_.empty()) return Error{Errc::no_permission, refusal_};
    if (end_) return std::nullopt;
    const unsigned long code = ERR_peek_last_error();
    const int reason = ERR_GET_REASON(code);
    if (reason > SSL_AD_REASON_OFFSET && reason < SSL_AD_REASON_OFFSET + 256) {
      return refused_by_alert(reason - SSL_AD_REASON_OFFSET);
    }
    if (reason == SSL_R_WRONG_VERSION_NUMBER || reason == SSL_R_HTTP_REQUEST ||
        reason == SSL_R_UNSUPPORTED_PROTOCOL) {
      return Error{Errc::protocol,
                   "the other side does not speak TLS 1.3; is it a dssmd with credentials? "
                   "(docs/security.md)"};
    }
    if (reason == SSL_R_PEER_DID_NOT_RETURN_A_CERTIFICATE) {
      return Error{Errc::no_permission, "the other side shows no certificate"};
    }
    const char* text = code ? ERR_reason_error_string(code) : nullptr;
    return Error{Errc::protocol, fmt::format("TLS: {}", text ? text : "the input is not valid")};
  }

  static Error refused_by_alert(int alert) {
    std::string text = fmt::format("the other side does not accept this one's certificate: {}",
                                   SSL_alert_desc_string_long(alert));
    switch (alert) {
      case SSL_AD_CERTIFICATE_EXPIRED:
      case SSL_AD_BAD_CERTIFICATE:  // also: not yet valid
        text += "; compare the clocks of both, and `dssmctl pki show`";
        break;
      case SSL_AD_UNKNOWN_CA:
      case SSL_AD_DECRYPT_ERROR:  // of an authority with the same name
        text += "; both need certificates of one authority (ca.crt)";
        break;
      case SSL_AD_CERTIFICATE_REVOKED:
      case SSL_AD_CERTIFICATE_UNKNOWN:
      case SSL_AD_CERTIFICATE_REQUIRED:
      case SSL_AD_UNSUPPORTED_CERTIFICATE:
        break;
      default:
        return {Errc::protocol,
                fmt::format("the other side ends TLS: {}", SSL_alert_desc_string_long(alert))};
    }
    return {Errc::no_permission, text + "; its log says more"};
  }

  static Error closed() {
    return {Errc::unavailable, "the other side closed the connection during the TLS handshake"};
  }

  // --- called by OpenSSL

  // Notes whose certificate is refused, and why. The other side gets an alert for the error.
  static int on_verified(int is_good, X509_STORE_CTX* check) {
    if (is_good && X509_STORE_CTX_get_error_depth(check) > 0) return 1;  // of an authority
    auto* session =
        static_cast<SSL*>(X509_STORE_CTX_get_ex_data(check, SSL_get_ex_data_X509_STORE_CTX_idx()));
    auto* self = static_cast<TlsTransport*>(SSL_get_app_data(session));
    X509* const certificate = X509_STORE_CTX_get0_cert(check);
    if (is_good) {
      const Result<CertifiedPeer> named = named_by(certificate);
      if (named) return 1;
      self->refusal_ = named.error().message;
      X509_STORE_CTX_set_error(check, X509_V_ERR_INVALID_PURPOSE);  // "unsupported certificate"
    } else {
      self->refusal_ = refusal_text(subject_of(certificate), X509_STORE_CTX_get_error(check));
    }
    return 0;
  }

  // OpenSSL handles these without an end while they come. When it believes that the other side has
  // ended, it stops before the next one.
  static void on_message(int is_sent, int, int type, const void*, std::size_t, SSL* session,
                         void* of) {
    auto& self = *static_cast<TlsTransport*>(of);
    if (is_sent || type != SSL3_RT_HANDSHAKE) return;
    if (++self.messages_ <= kMaxMessages + self.data_bytes_ / kDataBytesPerMessage) return;
    self.lower_error_ = Error{Errc::protocol, "the other side changes its keys all the time"};
    SSL_set_shutdown(session, SSL_RECEIVED_SHUTDOWN);
  }

  static int on_write(BIO* bio, const char* bytes, std::size_t count, std::size_t* written) {
    auto& self = *static_cast<TlsTransport*>(BIO_get_data(bio));
    std::vector<std::byte>& output = self.output_;
    if (output.empty()) output.swap(spare_output());
    const auto* from = reinterpret_cast<const std::byte*>(bytes);
    try {
      output.insert(output.end(), from, from + count);
    } catch (const std::bad_alloc&) {  // which must not go through OpenSSL
      self.lower_error_ = Error{Errc::no_memory, "no memory is left to encrypt"};
      return 0;
    }
    *written = count;
    return 1;
  }

  static int on_read(BIO* bio, char* bytes, std::size_t count, std::size_t* read) {
    auto& self = *static_cast<TlsTransport*>(BIO_get_data(bio));
    BIO_clear_retry_flags(bio);
    // The last receive took all that was there.
    if (std::exchange(self.is_input_taken_, false)) return BIO_set_retry_read(bio), 0;
    const iovec space{bytes, count};
    const Result<IoResult> received = self.lower_->receive({&space, 1});
    if (!received) {
      self.lower_error_ = received.error();
      return 0;
    }
    switch (received->status) {
      case IoStatus::ok:
        self.is_input_taken_ = received->bytes < count;
        *read = received->bytes;
        return 1;
      case IoStatus::end:
        self.end_ = true;
        return 0;
      case IoStatus::would_block:
      case IoStatus::interrupted:
        BIO_set_retry_read(bio);
        return 0;
    }
    return 0;
  }

  static long on_control(BIO*, int command, long, void*) {
    return command == BIO_CTRL_FLUSH ? 1 : 0;  // flush() is called by this file
  }

  static BIO_METHOD* method() {
    static BIO_METHOD* const made = [] {
      BIO_METHOD* method = BIO_meth_new(BIO_get_new_index() | BIO_TYPE_SOURCE_SINK, "dssm");
      BIO_meth_set_write_ex(method, on_write);
      BIO_meth_set_read_ex(method, on_read);
      BIO_meth_set_ctrl(method, on_control);
      return method;
    }();
    return made;
  }

  const std::shared_ptr<const TlsCredentials> credentials_;
  const std::unique_ptr<Transport> lower_;
  TlsTicket* const ticket_;
  SSL* const session_;
  std::optional<CertifiedPeer> peer_;  // when the handshake is done
  std::vector<std::byte> output_;      // encrypted, not sent
  std::size_t output_sent_ = 0;
  std::size_t batch_bytes_ = kBatchBytes;
  bool has_more_input_ = false;
  bool is_input_taken_ = false;                  // by the last call of lower_->receive()
  bool end_ = false;                             // of the input
  std::uint64_t records_ = 0;                    // sent
  std::uint64_t messages_ = 0, data_bytes_ = 0;  // received: of TLS itself, and of data
  std::optional<Error> ended_with_;              // after data that was received before
  std::optional<Error> lower_error_;
  std::string refusal_;  // of the other side's certificate
};

TlsTicket::~TlsTicket() { SSL_SESSION_free(session_); }

TlsHandshake::TlsHandshake(std::shared_ptr<const TlsCredentials> credentials,
                           std::unique_ptr<Transport> lower, TransportEnd end, TlsTicket* ticket)
    : transport_(
          std::make_unique<TlsTransport>(std::move(credentials), std::move(lower), end, ticket)) {}
TlsHandshake::TlsHandshake(TlsHandshake&&) noexcept = default;
TlsHandshake& TlsHandshake::operator=(TlsHandshake&&) noexcept = default;
TlsHandshake::~TlsHandshake() = default;

Result<bool> TlsHandshake::go_on() { return transport_->go_on(); }
short TlsHandshake::events() const noexcept { return transport_->events(); }
int TlsHandshake::fd() const noexcept { return transport_->fd(); }
std::unique_ptr<Transport> TlsHandshake::take_transport() { return std::move(transport_); }

}  // namespace dssm::wire
