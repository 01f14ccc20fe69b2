// Hands of a RHOT rig in Unity (2021 or newer). Start `rhot bridge json --transport udp --axes unity`, put this script on
// an empty object, press Play. Each joint is a small ball; use `Joint(side, k)` for your own bones.
using System;
using System.Net;
using System.Net.Sockets;
using System.Text;
using UnityEngine;

public class RhotHands : MonoBehaviour
{
    [Serializable] public class Hand { public string side, state; public float weight; public float[] positions, orientations, radii; }
    [Serializable] public class Frame { public double t; public string axes; public Hand[] hands; }

    public int port = 8766;
    UdpClient socket;
    readonly Transform[,] joints = new Transform[2, 26]; // left, right; OpenXR's 26 joints: 0 palm, 1 wrist, 2 thumb, …

    void OnEnable()
    {
        socket = new UdpClient(new IPEndPoint(IPAddress.Loopback, port)); // IPAddress.Any: a rig on another machine
        for (int side = 0; side < 2; side++)
            for (int k = 0; k < 26; k++)
            {
                var ball = GameObject.CreatePrimitive(PrimitiveType.Sphere);
                ball.name = (side == 0 ? "left " : "right ") + k;
                ball.transform.SetParent(transform, false);
                ball.SetActive(false);
                joints[side, k] = ball.transform;
            }
    }

    public Transform Joint(string side, int k) => joints[side == "left" ? 0 : 1, k];

    void Update()
    {
        byte[] newest = null;
        var sender = new IPEndPoint(IPAddress.Any, 0);
        while (socket.Available > 0) newest = socket.Receive(ref sender);
        if (newest == null) return;
        var frame = JsonUtility.FromJson<Frame>(Encoding.UTF8.GetString(newest));
        if (frame.axes != "unity") { Debug.LogError("start the bridge with --axes unity"); return; }
        foreach (var ball in joints) ball.gameObject.SetActive(false);
        foreach (var hand in frame.hands)
            for (int k = 0; k < 26; k++)
            {
                var p = hand.positions; var q = hand.orientations; var ball = Joint(hand.side, k);
                ball.localPosition = new Vector3(p[3 * k], p[3 * k + 1], p[3 * k + 2]);
                ball.localRotation = new Quaternion(q[4 * k], q[4 * k + 1], q[4 * k + 2], q[4 * k + 3]);
                ball.localScale = Vector3.one * 2 * hand.radii[k] * hand.weight;
                ball.gameObject.SetActive(true);
            }
    }

    void OnDisable()
    {
        socket.Close();
        foreach (var ball in joints) if (ball) Destroy(ball.gameObject);
    }
}
